"""Writes transmission and reflection as one layered image for editors.

OpenRaster (baseline 0.0.6), a format of Krita, GIMP and MyPaint, is a zip archive with stack.xml
and a PNG for each layer. The reflection is above the transmission, with the blend mode svg:plus:
the sum of both layers is the photo.

svg:plus adds the alpha of the layers, too (W3C Compositing and Blending, "lighter"), which is right
where alpha is zero or one. For a photo with partly transparent pixels, the layers are therefore
opaque, in a group that svg:src-atop limits to the alpha of a third layer below it, the photo.

Editors add the stored values, not linear light (GIMP reads svg:plus as its legacy mode), so the
reflection is the difference of the stored values. The option `additive` writes layers whose linear
light sums to the photo.
"""

import io
import zipfile
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Final, final

import numpy as np

from brewster.errors import UnsupportedPhoto
from brewster.photo.photo import Photo

_FORMAT: Final = "ora"
_MIME_TYPE: Final = "image/openraster"
_EPOCH: Final = (1980, 1, 1, 0, 0, 0)
"""The date of all files in a zip archive: the earliest possible one."""
_THUMBNAIL_PX: Final = 256  # the maximum of the specification
_IMAGE: Final = """<?xml version="1.0" encoding="UTF-8"?>
<image version="0.0.6" w="{width}" h="{height}">
 <stack>
{layers} </stack>
</image>
"""
_LAYERS: Final = """\
  <layer name="reflection" src="data/reflection.png" composite-op="svg:plus" \
opacity="1.0" visibility="visible" x="0" y="0"/>
  <layer name="transmission" src="data/transmission.png" composite-op="svg:src-over" \
opacity="1.0" visibility="visible" x="0" y="0"/>
"""
_LAYERS_WITH_ALPHA: Final = f"""\
  <stack name="layers" composite-op="svg:src-atop" opacity="1.0" visibility="visible">
{_LAYERS}  </stack>
  <layer name="photo" src="data/photo.png" composite-op="svg:src-over" \
opacity="1.0" visibility="visible" x="0" y="0"/>
"""


def zip_images(files: Iterable[tuple[str, bytes]]) -> bytes:
    """Returns a zip archive of (name, content) in this order. The same files always give the same
    bytes. The archive is not compressed, because image files are already compressed.
    """
    archive_file = io.BytesIO()
    with zipfile.ZipFile(archive_file, "w", zipfile.ZIP_STORED) as archive:
        for name, data in files:
            archive.writestr(zipfile.ZipInfo(name, _EPOCH), data)
    return archive_file.getvalue()


@final
@dataclass(frozen=True)
class LayeredImage:
    """Transmission and reflection of a photo as the layers of one file."""

    photo: Photo
    transmission: Photo

    def encode(self, format_name: str = _FORMAT) -> bytes:
        """Returns the bytes of an OpenRaster file with the profile of the photo, in 8 or 16 bits.

        The stored values of both layers sum to those of the photo exactly. The reflection is never
        negative, because the transmission is clipped to the photo where it is brighter. The
        composite has the alpha of the photo. Raises UnsupportedPhoto if `format_name` is not "ora".
        """
        if format_name != _FORMAT:
            raise UnsupportedPhoto(
                f"both layers in one file were requested as {format_name}",
                f"expected {_FORMAT}, the only format with layers that brewster writes",
                f"choose the suffix .{_FORMAT}",
            )
        bits = 8 if self.photo.pixels.dtype == np.uint8 else 16
        like_photo = self.transmission
        has_type = like_photo.pixels.dtype == self.photo.pixels.dtype
        # Additive layers are linear floats.
        if not (has_type and like_photo.colour_space() == self.photo.colour_space()):
            like_photo = self.photo.with_linear(like_photo.linear())
        photo, transmission = (layer.stored_as("png", bits) for layer in (self.photo, like_photo))
        behind = np.minimum(photo.pixels, transmission.pixels)
        info = replace(
            photo.file_info, format_name="png", bits=bits, xmp=self.transmission.file_info.xmp
        )
        width, height = photo.size
        merged = Photo(photo.pixels, photo.alpha, info).encode()
        alpha = photo.alpha
        photo_layer = {}
        layers = _LAYERS
        if alpha is not None and ((alpha > 0) & (alpha < np.iinfo(alpha.dtype).max)).any():
            alpha = np.where(alpha > 0, np.iinfo(alpha.dtype).max, 0).astype(alpha.dtype)
            photo_layer = {"data/photo.png": merged}
            layers = _LAYERS_WITH_ALPHA
        files = {
            "mimetype": _MIME_TYPE.encode(),  # must be the first file, and not compressed
            "stack.xml": _IMAGE.format(width=width, height=height, layers=layers).encode(),
            "data/transmission.png": Photo(behind, alpha, info).encode(),
            "data/reflection.png": Photo(photo.pixels - behind, alpha, info).encode(),
            **photo_layer,
            "mergedimage.png": merged,
            "Thumbnails/thumbnail.png": photo.thumbnail(_THUMBNAIL_PX).encode("png", depth=8),
        }
        return zip_images(files.items())
