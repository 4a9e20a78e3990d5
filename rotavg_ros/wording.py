"""Words about numbers, for what people read."""


def counted(number: int, what: str) -> str:
    """A number of things, named in the singular: ``1 edge``, ``2 edges``."""
    return f"{number} {what}" if number == 1 else f"{number} {what}s"
