"""Buffer sizes that grow in few steps, because every static size is a compilation."""


def next_capacity(count: float | int, *, base: int = 1024) -> int:
    """The smallest size >= `count` on the ladder base, 1.5 base, 1.5^2 base ... (multiples of 256).

    With static sizes from this ladder, growing work recompiles only a logarithmic number of times.
    """
    size = base
    while size < count:
        size = -(-size * 3 // 512) * 256
    return size
