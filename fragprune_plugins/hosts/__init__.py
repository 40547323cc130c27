"""What a host is: its source, read without an import, and the adapter that describes it.

source    reads a checkout              findings  what reading brings to light
seams     where a host is entered       adapter   what every adapter says of its host
choosing  which adapter fits            dialect   how a host calls its rasterizer
"""
