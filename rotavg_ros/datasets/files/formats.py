"""The formats of view-graph files: on reading chosen by the content, on writing by the suffix."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from types import ModuleType

from rotavg_ros.datasets.files import g2o, isam, lund, npz, onedsfm, toro
from rotavg_ros.datasets.files.graph_file import GZIP, GraphFile, GraphFileError, open_text, reading
from rotavg_ros.datasets.files.text_rows import NUMBER_STARTS, read_blocks
from rotavg_ros.packed import head_of, how_to_unpack

_FORMAT_OF_SUFFIX = {
    ".g2o": g2o,
    ".graph": toro,
    ".toro": toro,
    ".isam": isam,
    ".npz": npz,
    ".txt": onedsfm,
}


_SQLITE = b"SQLite format 3"
# How recordings begin, and their suffixes.
_RECORDINGS = {b"\x89MCAP": ".mcap", _SQLITE: ".db3", b"#ROSBAG V": ".bag"}
# A table that other programs' databases have, and what to say of these.
_DATABASES = {
    "link": "is RTAB-Map's database; export its graph as g2o (rtabmap-databaseViewer: File, Export poses)",
    "two_view_geometries": "is COLMAP's database; write its relative rotations as an npz view-graph (docs/formats.md)",
}
# Numbers in a row of a trajectory.
_TRAJECTORIES = {8: "TUM", 12: "KITTI"}


def read_graph(path: str | Path) -> GraphFile:
    """Read a view-graph in g2o or TORO dialect, 1DSfM ``EGs.txt``, npz or Lund's MATLAB form; the content decides.

    Texts may begin with UTF-8's byte order mark and may be compressed by gzip.

    Returns:
        a graph of indices with the file's ids beside it; :func:`rotavg_ros.solve` takes it as it is.

    Raises:
        GraphFileError: anything that keeps the file from being read whole.
    """
    path = Path(path)
    with reading(path):
        is_special = path.exists() and not path.is_file() and not path.is_dir()
    if is_special:
        raise GraphFileError.at(path, None, "is not a regular file (a pipe or a device); save the graph to one first")
    with open_text(path) as file:
        head = file.read(4096)
    if not head:
        expected = "a view-graph (g2o, TORO, iSAM, EGs.txt, npz or Lund's .mat)"
        raise GraphFileError.at(path, None, f"the file is empty; expected {expected}")
    return _format_of_content(path, head).read(path)  # type: ignore[no-any-return]


def write_graph(path: str | Path, graph_file: GraphFile) -> None:
    """Write a view-graph; the suffix decides.

    ``.g2o``, ``.toro`` or ``.graph`` (TORO), ``.isam``, ``.npz``, or ``.txt`` (1DSfM).
    The file appears under its name only when it is complete.

    Raises:
        GraphFileError: an unknown suffix, or a place that cannot be written.
    """
    path = Path(path)
    _format_of_suffix(path).write(path, graph_file)


def not_stored(path: str | Path, graph_file: GraphFile) -> list[str]:
    """The parts of this graph that the format of ``path`` cannot store, in words."""
    return _format_of_suffix(Path(path)).not_stored(graph_file)  # type: ignore[no-any-return]


def stem_of(path: Path) -> str:
    """The file's name without its suffix and that of gzip."""
    return Path(path.stem).stem if path.suffix.lower() == ".gz" else path.stem


def _format_of_suffix(path: Path) -> ModuleType:
    chosen = _FORMAT_OF_SUFFIX.get(path.suffix.lower())
    if chosen is None:
        usable = ".g2o, .toro, .graph (TORO), .isam, .npz or .txt (1DSfM EGs.txt)"
        raise GraphFileError.at(path, None, f"unknown suffix {path.suffix!r}; use {usable}")
    return chosen


def _format_of_content(path: Path, head: bytes) -> ModuleType:
    binary = None
    if head.startswith(b"PK") or path.suffix.lower() == ".npz":  # npz files are zip archives
        binary = npz
    elif head.startswith(b"MATLAB ") or path.suffix.lower() == ".mat":
        binary = lund
    if binary is not None:
        if (start := head_of(path)).startswith(GZIP) and (packed := how_to_unpack(path, start)) is not None:
            raise GraphFileError.at(path, None, packed)  # only texts are read as they are packed
        return binary
    for start, suffix in _RECORDINGS.items():
        if head.startswith(start):
            if start == _SQLITE and (database := _database(path)) is not None:
                raise GraphFileError.at(path, None, database)
            if (packed := how_to_unpack(path, head_of(path))) is not None:
                raise GraphFileError.at(path, None, packed)
            what = f"is a bag; `rotavg replay` takes it, and `rotavg convert` makes a view-graph of a {suffix} file"
            raise GraphFileError.at(path, None, what)
    first_row = next((row for block in read_blocks(path) for _, row in block), [b""])
    if first_row[0][:1] in NUMBER_STARTS and len(first_row) in _TRAJECTORIES:
        kind = _TRAJECTORIES[len(first_row)]
        what = f"{len(first_row)} numbers a row, as in a trajectory ({kind}), which has no edges; `rotavg replay "
        raise GraphFileError.at(path, 1, f"{what}--reference` compares with one")
    return onedsfm if first_row[0][:1] in NUMBER_STARTS else g2o


def _database(path: Path) -> str | None:
    """What to say of an SQLite file that is no recording; None: it is one, or its tables cannot be read."""
    import sqlite3  # which graphs do not need, and some builds of Python lack

    try:
        with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True)) as database:
            tables = {name.lower() for (name,) in database.execute("SELECT name FROM sqlite_master")}
    except (sqlite3.Error, ValueError):  # a damaged file; a name that is no text
        return None
    known = (told for table, told in _DATABASES.items() if table in tables)
    return next(known, None)
