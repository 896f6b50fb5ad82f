import mmap

import numpy as np

def find_events(content: mmap.mmap | bytes) -> tuple[dict[bytes, np.ndarray], list[tuple[int, str]]]:
    """The events of a file, by their channels, and offset and nature of what is not an event.

    Of an event there are: its number, its time in microseconds, begin and end of its data in the file. So a channel
    with n events has integers of shape (n, 4), in the order of the file. Where a header is not one, or its lengths lead
    to no other event, the next sync word is looked for.
    """

def whole_cycles(
    content: mmap.mmap | bytes, places: np.ndarray, dtype: np.dtype
) -> tuple[np.ndarray, np.ndarray, list[tuple[int, str]]]:
    """The cycles that are whole, in order.

    Args:
        content: of the file.
        places: of the cycles' events, of shape (n, 4), as of `find_events`.
        dtype: of a cycle, as of `CycleLayout`.

    Returns:
        Records of that type, of shape (m,); which bytes of the file belong to each: begin and end, of shape (m, 2);
        offset and nature of what does not count: another length, a wrong checksum, a number that is no later one.

    Raises:
        IndexError: a place is outside the file.
    """
