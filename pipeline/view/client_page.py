"""The page of viser, whose splats get corners with three coordinates.

The corners of viser 1.1's splats have two. three.js computes a bounding sphere of them, finds NaN and writes an error
into the browser's console; since nothing compares with NaN, splats are drawn wherever they are. With a third coordinate
the sphere is known, and a further property has them drawn wherever they are, as before. viser's program is packed into
its page and unpacked by the browser, which is where it is changed; the page of another version, which does not have
these words, stays as it is.
"""

from __future__ import annotations

_UNPACKED = b"const code=td.decode(heap.subarray(up+ss,up+sz))"
"""Where the browser has unpacked the program."""
_CORNERS = b".replace('Float32Array([-2,-2,2,-2,2,2,-2,2]),2)','Float32Array([-2,-2,0,2,-2,0,2,2,0,-2,2,0]),3)')"
_DRAWN = (
    rb".replace(/(geometry:[\w$]+\.geometry,material:[\w$]+\.material,renderOrder:[\w$]+)\}/,"
    rb'"$1,frustumCulled:!1}")'
)


def with_whole_corners(page: bytes) -> bytes:
    """Return viser's page with corners of splats that have three coordinates."""
    return page.replace(_UNPACKED, _UNPACKED + _CORNERS + _DRAWN) if page.count(_UNPACKED) == 1 else page
