"""A view-graph as stored in files: with the ids, stamps, translations and ground truth that the solver does not need.

:func:`read_graph` and :func:`write_graph` choose the format; the formats themselves are modules with a
``read(path)``, a ``write(path, graph_file)`` and a ``not_stored(graph_file)`` each.
"""

from __future__ import annotations

import codecs
import gzip
import io
import zlib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch

from rotavg_ros.errors import UserError
from rotavg_ros.packed import HEAD, how_to_unpack
from rotavg_ros.view_graph import EdgeLabel, ViewGraph, where_possible
from rotavg_ros.whole_file import real, replacing

# Ids are non-negative so that they fit the unsigned 64-bit ids of the messages and of gtsam's keys.
MAX_NODE_ID = np.iinfo(np.int64).max

# With fewer ids, or a smaller share of neighbours that are joined, the nodes may be cameras instead of keyframes.
_MIN_CHAIN, _CHAIN_SHARE = 10, 0.9
# Largest number of keyframes in a row that a front end drops again.
_DROPPED = 30

GZIP, _ZIP = b"\x1f\x8b", b"PK"


class GraphFileError(UserError):
    """A file that cannot be read or written.

    The message names the file, the line where there is one, what is wrong and what to do.
    """

    @classmethod
    def at(cls, path: str | Path, line: int | None, what: str) -> GraphFileError:
        """``path:line: what``, or ``path: what`` without a line."""
        return cls(f"{path}:{line}: {what}" if line is not None else f"{path}: {what}")


@dataclass(frozen=True)
class GraphFile:
    """A view-graph as read from or written to a file (N nodes, M edges).

    Attributes:
        graph: the edges; nodes are indices into ``node_ids``.
        node_ids: ``(N,)`` int64, ascending, non-negative: index → id in the file.
        planar: every rotation is about z (an SE(2) graph).
        edge_translation: ``(M, 3)`` position of the target in the source frame, metres (SfM: of unknown scale); NaN
            where unknown. Default: the graph's.
        edge_information: ``(M, 21)`` upper triangle, row by row, of the 6 × 6 information matrix of x, y, z and the
            rotation, as stated by formats that have one. Planar edges have zeros for z, roll and pitch. What solvers
            read of it is the graph's ``information``.
        body_from_world_gt: ``(N, 4)`` xyzw ground truth; NaN rows where unknown.
        stamps_ns: ``(N,)`` int64 nanoseconds.
        position_gt: ``(N, 3)`` ground truth in the world frame, metres; NaN rows where unknown.
        skipped: number of lines that were left out on reading, by kind.
        damage: what could not be read of a damaged recording; None: it was whole.
        warnings: why the graph may not be what was meant, a line each.
    """

    graph: ViewGraph
    node_ids: np.ndarray
    planar: bool = False
    edge_translation: np.ndarray | None = None
    body_from_world_gt: np.ndarray | None = None
    stamps_ns: np.ndarray | None = None
    position_gt: np.ndarray | None = None
    skipped: dict[str, int] = field(default_factory=dict)
    edge_information: np.ndarray | None = None
    damage: str | None = None
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Copy the translations between here, where formats use them, and the graph, which is all a solver sees."""
        if self.edge_translation is None and self.graph.translation is not None:
            object.__setattr__(self, "edge_translation", self.graph.translation.cpu().numpy())
        elif self.edge_translation is not None:
            translation = torch.as_tensor(self.edge_translation, dtype=torch.float64)
            object.__setattr__(self, "graph", replace(self.graph, translation=where_possible(translation)))

    @property
    def consecutive(self) -> np.ndarray:
        """``(M,)`` bool: edges that formats without kinds take for odometry, see :func:`joins_consecutive`."""
        source, target = (self.node_ids[end.cpu().numpy()] for end in (self.graph.source, self.graph.target))
        return joins_consecutive(source, target)

    @property
    def extras(self) -> list[str]:
        """The parts that only npz can store, and those that no format can, in words."""
        graph = self.graph
        known = {
            "labels": bool((graph.label != EdgeLabel.AUTOMATIC).any()),
            "how many steps odometry edges stand for": bool((graph.steps[graph.is_odometry] != 1).any()),
            "stamps": self.stamps_ns is not None,
            "ground-truth orientations": self.body_from_world_gt is not None,
            "ground-truth positions": self.position_gt is not None,
        }
        return [name for name, is_known in known.items() if is_known] + self.in_no_file

    @property
    def in_no_file(self) -> list[str]:
        """The parts that no format can store, in words; everything else is found by reading."""
        return [] if self.graph.route is None else ["which ways odometry went along edges drawn together"]

    @classmethod
    def from_ids(
        cls,
        source_ids: np.ndarray,
        target_ids: np.ndarray,
        target_from_source: np.ndarray,
        *,
        lone_ids: np.ndarray | None = None,
        kind: np.ndarray | None = None,
        precision: np.ndarray | None = None,
        label: np.ndarray | None = None,
        planar: bool = False,
        edge_translation: np.ndarray | None = None,
        edge_information: np.ndarray | None = None,
        information: np.ndarray | None = None,
        steps: np.ndarray | None = None,
        skipped: dict[str, int] | None = None,
    ) -> GraphFile:
        """Build from edges between ids instead of indices.

        Args:
            source_ids, target_ids: ``(M,)`` int64.
            target_from_source: ``(M, 4)`` xyzw.
            lone_ids: ids that are nodes even if no edge names them.

        Raises:
            ViewGraphError: as :meth:`ViewGraph.create`.
        """
        num_edges = len(source_ids)
        lone_ids = np.empty(0, dtype=np.int64) if lone_ids is None else lone_ids
        node_ids, index = np.unique(np.concatenate((source_ids, target_ids, lone_ids)), return_inverse=True)
        graph = ViewGraph.create(
            index[:num_edges],
            index[num_edges : 2 * num_edges],
            target_from_source,
            num_nodes=len(node_ids),
            kind=kind,
            precision=precision,
            label=label,
            steps=steps,
            information=information,
        )
        return cls(
            graph,
            node_ids.astype(np.int64),
            planar,
            edge_translation=edge_translation,
            edge_information=edge_information,
            skipped=dict(skipped or {}),
        )


def joins_consecutive(source_ids: np.ndarray, target_ids: np.ndarray) -> np.ndarray:
    """``(M,)`` bool: which edges are odometry, judged only by ids.

    These are edges between consecutive ids. Where a front end numbers frames and keeps some (0, 5, 10 …), or drops some
    of its keyframes (3, 4, 6, 7 …), they are the edges between ids that follow each other among those that occur. That
    holds if such edges join nearly all of these; far ids are another robot's.

    Args:
        source_ids, target_ids: ``(M,)`` int64.
    """
    consecutive = np.abs(source_ids - target_ids) == 1
    ids, index = np.unique(np.concatenate((source_ids, target_ids)), return_inverse=True)
    ends = index.reshape(2, -1)
    is_next = np.abs(ends[0] - ends[1]) == 1
    joined = np.unique(ends[:, is_next].min(axis=0))
    if len(ids) < _MIN_CHAIN or len(joined) < _CHAIN_SHARE * (len(ids) - 1):
        return np.asarray(consecutive)
    usual = float(np.median(np.diff(ids)[joined]))
    return np.asarray(is_next & (np.abs(source_ids - target_ids) <= (_DROPPED + 1) * usual))


@contextmanager
def open_text(path: Path) -> Iterator[io.BufferedReader]:
    """A text's bytes from the first character on, decompressed if gzipped, without a byte order mark.

    Raises:
        GraphFileError: the file cannot be read, is UTF-16, a damaged gzip file, or packed by anything but gzip.
    """
    with reading(path), ExitStack() as stack:
        file = stack.enter_context(path.open("rb"))
        if file.peek(len(GZIP)).startswith(GZIP):
            file = io.BufferedReader(stack.enter_context(gzip.GzipFile(fileobj=file)))
        try:
            start = file.peek(len(codecs.BOM_UTF8))
            if start.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
                what = "is UTF-16 text; save it as UTF-8 (iconv -f UTF-16 -t UTF-8)"
                raise GraphFileError.at(path, None, what)
            if start.startswith(codecs.BOM_UTF8):
                file.read(len(codecs.BOM_UTF8))
            # Archives of zip, which npz is one of, are told by their content; tar may be packed by gzip.
            head = file.peek(HEAD)[:HEAD]
            if not head.startswith(_ZIP) and (packed := how_to_unpack(path, head)) is not None:
                raise GraphFileError.at(path, None, packed)
            yield file
        except (EOFError, gzip.BadGzipFile, zlib.error) as error:
            raise GraphFileError.at(path, None, f"is a damaged gzip file: {error}; get or pack it again") from None


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn the operating system's errors about ``path`` into a :class:`GraphFileError`."""
    try:
        yield
    except FileNotFoundError:
        raise GraphFileError.at(path, None, "no such file; check the path") from None
    except IsADirectoryError:
        raise GraphFileError.at(
            path, None, "is a directory; give a file (`rotavg convert` makes a view-graph file of a bag)"
        ) from None
    except PermissionError:
        raise GraphFileError.at(path, None, "permission denied; check the file's rights") from None
    except OSError as error:
        raise GraphFileError.at(path, None, f"cannot be read: {error.strerror or error}") from None


@contextmanager
def writing(path: Path) -> Iterator[Path]:
    """A file to write that takes the place of ``path`` on success, see :func:`~rotavg_ros.whole_file.replacing`.

    Raises:
        GraphFileError: the place cannot be written (missing folder, permissions, full disk).
    """
    try:
        with replacing(path) as temporary:
            yield temporary
    except OSError as error:
        what = f"cannot be written: {error.strerror or error}"
        if isinstance(error, FileNotFoundError) and not (folder := real(path).parent).exists():
            what = f"cannot be written: there is no folder {folder}; make it first"
        raise GraphFileError.at(path, None, what) from None
