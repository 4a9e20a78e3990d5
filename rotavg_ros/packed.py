"""Files that are packed in a way that nothing here reads: how to tell them, and what unpacks them."""

from __future__ import annotations

import shlex
from contextlib import suppress
from pathlib import Path

# How packed files begin, and the command that unpacks one and keeps it.
_PACKED = {
    b"BZh": ("bzip2", "bunzip2 --keep {}"),
    b"\xfd7zXZ\x00": ("xz", "unxz --keep {}"),
    b"\x28\xb5\x2f\xfd": ("zstd", "unzstd {}"),
    b"\x04\x22\x4d\x18": ("lz4", "unlz4 {}"),
    b"\x1f\x8b": ("gzip", "gunzip --keep {}"),
    b"PK\x03\x04": ("zip", "unzip {}"),
}
_TAR, _TAR_AT = b"ustar", 257
_TAR_SUFFIXES = (".tgz", ".tbz2", ".txz")
# So many bytes of a file tell.
HEAD = _TAR_AT + len(_TAR)


def head_of(path: Path) -> bytes:
    """A file's first :data:`HEAD` bytes; none if it is no regular file, or cannot be read."""
    with suppress(OSError):
        if path.is_file():
            with path.open("rb") as file:
                return file.read(HEAD)
    return b""


def how_to_unpack(path: Path, head: bytes) -> str | None:
    """What to say of a packed file, without its name; None: it is not packed.

    Args:
        path: of the file.
        head: its first :data:`HEAD` bytes, or all.
    """
    quoted = shlex.quote(str(path))
    is_tar = head[_TAR_AT:].startswith(_TAR) or ".tar" in path.suffixes or path.suffix in _TAR_SUFFIXES
    packed = next((known for start, known in _PACKED.items() if head.startswith(start)), None)
    if is_tar and (packed is not None or head[_TAR_AT:].startswith(_TAR)):
        return f"is an archive by tar; unpack it by `tar -xf {quoted}`"
    if packed is None:
        return None
    name, command = packed
    return f"is packed by {name}; unpack it by `{command.format(quoted)}`"
