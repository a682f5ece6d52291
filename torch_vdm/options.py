"""Checks of options: whatever is wrong with one is a ValueError."""

from collections.abc import Sequence


def number(name: str, value: object) -> float:
    """Return an option that is a number, of Python, NumPy or torch; refuse others."""
    if not isinstance(value, bool | str | bytes):
        try:
            return float(value)  # type: ignore[arg-type]  # what it cannot be made of raises
        except (TypeError, ValueError, RuntimeError, OverflowError):
            pass
    raise ValueError(f"expected {name}: a number, got {value!r}")


def switch(name: str, value: object) -> bool:
    """Return an option that is True or False; refuse others."""
    if not isinstance(value, bool):
        raise ValueError(f"expected {name}: True or False, got {value!r}")
    return value


def choice(name: str, value: object, known: Sequence[str]) -> None:
    """Refuse an option that is not one of those known."""
    if not isinstance(value, str) or value not in known:
        *others, last = (f'"{one}"' for one in known)
        raise ValueError(f"expected {name} {', '.join(others)} or {last}, got {value!r}")
