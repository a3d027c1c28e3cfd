"""Frame ranges as users write them."""

from .errors import UsageError


def frame_range(text: str | None, count: int) -> range:
    """ "A:B" of `count` frames: a Python slice, either end optional; None means all frames.

    Raises:
        UsageError: the text has another form, or the range holds no frame.
    """
    if text is None:
        return range(count)
    try:
        a, b = text.split(":")
        chosen = range(count)[slice(int(a) if a else None, int(b) if b else None)]
    except ValueError:
        raise UsageError(f"--frames {text} is not a range, expected A:B such as 0:20") from None
    if not chosen:
        raise UsageError(f"--frames {text} holds no frame, the sequence has frames 0 to {count - 1}")
    return chosen
