"""Static sizes that grow in few steps."""


def next_capacity(count: float | int, *, base: int = 1024) -> int:
    """The smallest size >= `count` on the ladder base, 1.5 base, 1.5^2 base ... (multiples of 256).

    Static sizes are taken from it, so that growing work recompiles a logarithmic number of times.
    """
    size = base
    while size < count:
        size = -(-size * 3 // 512) * 256
    return size
