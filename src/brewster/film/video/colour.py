"""Converts a decoded frame of a video into 8-bit sRGB, upright and with square pixels.

HDR frames (HLG, PQ) become the light of a display, relative to the reference white of ITU-R BT.2408
(203 cd/m2), then get the primaries of BT.709. Highlights are compressed. The result has the code
values with which an SDR display shows this light.
"""

from typing import Final

import av
import cv2
import numpy as np
from av.video.reformatter import ColorRange, Colorspace
from numpy.typing import NDArray

from brewster.photo.srgb import to_encoded, to_linear

Floats = NDArray[np.float32]

_HLG: Final = 18
_PQ: Final = 16
HDR_NAMES: Final = {_HLG: "HLG", _PQ: "PQ"}
"""The transfer characteristics of HDR, by their codes in ITU-T H.273."""
_TO_BT709: Final = {  # from the colour primaries of H.273, all with the white D65
    9: (
        (1.6605, -0.5876, -0.0728),
        (-0.1246, 1.1329, -0.0083),
        (-0.0182, -0.1006, 1.1187),
    ),  # BT.2020
    12: ((1.2249, -0.2247, 0.0), (-0.0420, 1.0419, 0.0), (-0.0197, -0.0786, 1.0979)),  # Display P3
}
_MATRICES: Final = {
    1: Colorspace.ITU709,
    4: Colorspace.FCC,
    5: Colorspace.ITU601,
    6: Colorspace.ITU601,
    7: Colorspace.SMPTE240M,
    9: Colorspace.BT2020,
}
"""The matrix from YCbCr to RGB for the matrix coefficients of H.273."""
_HD_PIXELS: Final = 1280 * 720
_KNEE: Final = 0.75
"""Brighter light than this share of the reference white is compressed, so that highlights up to
1000 cd/m2 stay below 1.
"""
_SDR_GAMMA: Final = 2.4
"""The gamma of an SDR display (ITU-R BT.1886)."""
_HLG_GAMMA: Final = 1.2
"""The gamma of an HLG display of 1000 cd/m2. It is applied to each channel, as in zimg, and not to
the luminance.
"""


def displayed_size(width: int, height: int, pixel_aspect: float) -> tuple[int, int]:
    """Returns the size with square pixels, before the rotation. No side becomes smaller."""
    return (round(width * max(1, pixel_aspect)), round(height / min(1, pixel_aspect)))


def to_picture(
    frame: av.VideoFrame,
    pixel_aspect: float,
    transfer: int,
    primaries: int,
    *,
    display_matrix: bytes | None = None,
) -> NDArray[np.uint8]:
    """Returns the picture as a player shows it.

    Args:
        frame: a decoded frame.
        pixel_aspect: the width of a pixel divided by its height.
        transfer: the transfer characteristics, a code of H.273.
        primaries: the colour primaries, a code of H.273.
        display_matrix: nine 32-bit integers, as FFmpeg gives them, or None.
    """
    is_deep = frame.format.components[0].bits > 8 or transfer in HDR_NAMES or primaries in _TO_BT709
    width, height = displayed_size(frame.width, frame.height, pixel_aspect)
    source = matrix_of(frame)
    is_full = int(frame.color_range) == ColorRange.JPEG or frame.format.name.startswith("yuvj")
    rgb = frame.reformat(
        format="rgb48le" if is_deep else "rgb24",
        src_colorspace=source,
        dst_colorspace=source,
        src_color_range=ColorRange.JPEG if is_full else ColorRange.MPEG,
        dst_color_range=ColorRange.JPEG,
    ).to_ndarray()
    if rgb.dtype != np.uint8:
        white = 65535 if is_full else 65280  # the values to which swscale converts white
        rgb = np.rint(_convert(rgb.astype(np.uint16), white, transfer, primaries) * 255)
    picture = rgb.astype(np.uint8)
    if (frame.width, frame.height) != (width, height):
        picture = cv2.resize(picture, (width, height), interpolation=cv2.INTER_CUBIC)
    return _upright(picture, display_matrix)


def matrix_of(frame: av.VideoFrame) -> Colorspace:
    """Returns the matrix from YCbCr to RGB. Untagged frames have BT.709 in HD, else BT.601."""
    matrix = _MATRICES.get(int(frame.colorspace))
    if matrix is None:
        is_hd = frame.width * frame.height >= _HD_PIXELS
        matrix = Colorspace.ITU709 if is_hd else Colorspace.ITU601
    return matrix


def _convert(codes: NDArray[np.uint16], white: int, transfer: int, primaries: int) -> Floats:
    """Returns values from 0 to 1 with the primaries of BT.709."""
    is_hdr = transfer in HDR_NAMES
    encoded = np.arange(65536) / white
    if not is_hdr and primaries not in _TO_BT709:
        return np.minimum(encoded, 1).astype(np.float32)[codes]
    table = _hdr_to_linear(encoded, transfer) if is_hdr else to_linear(encoded)
    linear = table.astype(np.float32)[codes]
    if primaries in _TO_BT709:
        linear = np.maximum(linear @ np.array(_TO_BT709[primaries], np.float32).T, 0)
    if is_hdr:
        return _soft_clipped(linear) ** np.float32(1 / _SDR_GAMMA)
    return to_encoded(np.minimum(linear, 1)).astype(np.float32)


def _hdr_to_linear(encoded: NDArray[np.float64], transfer: int) -> NDArray[np.float64]:
    """Returns the light of a display, 1 for the reference white: HLG at 75 %, PQ at 203 cd/m2. The
    constants are those of BT.2100.
    """
    light: NDArray[np.float64]
    if transfer == _HLG:
        a = 0.17883277
        b = 0.28466892
        c = 0.55991073
        light = np.where(encoded <= 0.5, encoded**2 / 3, (np.exp((encoded - c) / a) + b) / 12)
        return (light / 0.26496) ** _HLG_GAMMA
    m1 = 2610 / 16384
    m2 = 2523 / 32
    c1 = 3424 / 4096
    c2 = 2413 / 128
    c3 = 2392 / 128
    power = np.minimum(encoded, 1) ** (1 / m2)
    light = (np.maximum(power - c1, 0) / (c2 - c3 * power)) ** (1 / m1)
    return light * (10_000 / 203)


def _soft_clipped(linear: Floats) -> Floats:
    """Compresses bright pixels below 1. The largest channel decides, so that the hue stays."""
    largest = np.maximum(linear.max(axis=-1, keepdims=True), _KNEE)
    room = 1 - _KNEE
    # The factor is 1 at the knee, and so is its slope
    factor: Floats = (1 - room * np.exp((_KNEE - largest) / room)) / largest
    return linear * factor


def is_turned(display_matrix: bytes | None) -> bool:
    """Returns whether a player exchanges width and height."""
    if display_matrix is None:
        return False
    a, b = np.abs(np.frombuffer(display_matrix, np.int32, 2)).tolist()
    return bool(b > a)


def _upright(picture: NDArray[np.uint8], display_matrix: bytes | None) -> NDArray[np.uint8]:
    """Applies the display matrix: (x, y) is shown at (a x + c y, b x + d y), with y downwards."""
    if display_matrix is None:
        return picture
    a, b, _, c, d = np.frombuffer(display_matrix, np.int32, 5).tolist()
    if is_turned(display_matrix):
        picture = picture.swapaxes(0, 1)
        a = c
        d = b
    return np.ascontiguousarray(picture[:: -1 if d < 0 else 1, :: -1 if a < 0 else 1])
