"""How large photographs are read."""

LARGEST = 1600
"""Pixels: wider photographs are shrunk to this width unless a size is asked for."""


def size_read(picture, args):
    """Width and height: a small number divides both, -1 leaves the choice, others are a width."""
    width, height = picture.size
    if args.resolution in (1, 2, 4, 8):
        return round(width / args.resolution), round(height / args.resolution)
    wanted = min(width, LARGEST) if args.resolution == -1 else args.resolution
    scale = width / wanted
    return int(width / scale), int(height / scale)
