"""Chooses the size at which photographs are read."""

LARGEST = 1600
"""Pixels. Wider photographs are reduced to this width unless an option gives the size."""


def size_read(picture, args):
    """(width, height) to read: 1, 2, 4 or 8 divide the size, -1 is automatic, others are widths."""
    width, height = picture.size
    if args.resolution in (1, 2, 4, 8):
        return round(width / args.resolution), round(height / args.resolution)
    wanted = min(width, LARGEST) if args.resolution == -1 else args.resolution
    scale = width / wanted
    return int(width / scale), int(height / scale)
