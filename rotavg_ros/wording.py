"""Words about numbers, for what people read."""

_NEARLY_ALL = 0.9


def counted(number: int, what: str) -> str:
    """A number of things, named in the singular: ``1 edge``, ``2 edges``."""
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def unless_nearly_all(known: int, total: int, what: str) -> str:
    """Where a figure is known, if that is not nearly everywhere: `` at 3 of 164 keyframes``; else nothing.

    Args:
        what: in the plural.
    """
    return "" if known > _NEARLY_ALL * total else f" at {known} of {total} {what}"
