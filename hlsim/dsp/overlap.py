"""Long signals in overlapping blocks, so that memory does not grow with them."""


def overlapping(samples: int, hop: int, lead: int, lag: int) -> list[tuple[int, int, int, int]]:
    """Begin, start, stop and end of blocks: what goes in, and within it what comes out.

    Args:
        samples: of the signal; up to one and a half ``hop``, or with a ``hop`` of 0, it is one block.
        hop: samples from the start of one block to that of the next; the last has from half to one and a half of it.
        lead, lag: samples that a block needs before its start and behind its stop.
    """
    if hop == 0 or samples <= 1.5 * hop:
        return [(0, 0, samples, samples)]
    starts = list(range(0, samples - hop // 2, hop))
    stops = [*starts[1:], samples]
    return [
        (max(0, start - lead), start, stop, min(samples, stop + lag) if stop < samples else samples)
        for start, stop in zip(starts, stops, strict=True)
    ]
