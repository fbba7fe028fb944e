"""Reads and writes floating-point images: OpenEXR with its own package, Radiance HDR with built-in
code.

Both formats store linear light. Header attributes are kept and written to new files.
"""

import io
import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brewster.errors import UnreadablePhoto, UnsupportedPhoto
from brewster.photo.colour.spaces import valid_chromaticities
from brewster.photo.file_info import (
    Decoded,
    FileInfo,
    check_pixel_count,
    library_of,
    with_notes,
)

Float32 = NDArray[np.float32]


def read_exr(data: bytes, max_pixels: int) -> Decoded:
    """Reads the first part of an EXR that has the channels R, G and B, or Y alone, and the channel
    A if there is one.

    Other channels, such as Z, are ignored. Raises MissingExtra if OpenEXR is not installed;
    PhotoTooLarge if the image has more pixels than `max_pixels`; UnreadablePhoto if the file is
    damaged or truncated; UnsupportedPhoto if the file has neither the channels R, G and B nor the
    channel Y, or its colours are luminance and chroma (Y, RY, BY).
    """
    parts = _exr_parts(data, header_only=True)
    names = [{channel.name for channel in part.header["channels"]} for part in parts]
    found = (i for i in range(len(parts)) if _has_colours(names[i]))
    index = next(found, 0)
    if len(parts) > 1 and index == 0 and not _has_colours(names[0]):
        listed = "; ".join(", ".join(sorted(channels)) for channels in names)
        raise UnsupportedPhoto(
            f"the {len(parts)} parts of the EXR have the channels {listed}",
            "expected a part with the channels R, G and B, or Y alone",
            "export the image as RGB",
        )
    header = parts[index].header
    low, high = header["dataWindow"]
    width, height = (int(side) for side in np.array(high) - np.array(low) + 1)
    check_pixel_count(width, height, max_pixels)
    part = _exr_parts(data, header_only=False)[index]
    decoded = _exr_pixels(
        {name: channel.pixels for name, channel in part.channels.items()}, dict(part.header)
    )
    if len(parts) == 1:
        return decoded
    others = ", ".join(
        str(part.header.get("name", i)) for i, part in enumerate(parts) if i != index
    )
    file_info = with_notes(decoded.file_info, f"its other parts are not read: {others}")
    return replace(decoded, file_info=file_info)


def _has_colours(names: set[str]) -> bool:
    return {*_LAYER_CHANNELS} <= names or "Y" in names


def _exr_parts(data: bytes, *, header_only: bool) -> Any:  # noqa: ANN401  (OpenEXR has no types)
    exr = library_of("exr")
    cause = None
    try:
        parts = exr.File(io.BytesIO(data), separate_channels=True, header_only=header_only).parts
    except (RuntimeError, ValueError, TypeError, IndexError) as error:
        parts = []
        cause = error
    if not parts:
        happened = "the EXR cannot be read completely"
        raise UnreadablePhoto(
            happened, "expected a complete file", "export the image again"
        ) from cause
    return parts


def _exr_pixels(channels: dict[str, NDArray[Any]], header: dict[str, Any]) -> Decoded:
    names = _LAYER_CHANNELS if {*_LAYER_CHANNELS} <= channels.keys() else ("Y",)
    if not set(names) <= channels.keys() or "RY" in channels:
        raise UnsupportedPhoto(
            f"the EXR has the channels {', '.join(sorted(channels))}",
            "expected the channels R, G and B, or Y alone, and optionally A",
            "export the image as RGB",
        )
    is_half = all(channels[name].dtype == np.float16 for name in names)
    attributes = {key: value for key, value in header.items() if key not in _OF_THE_FILE}
    primaries = valid_chromaticities(header.get("chromaticities", ()))
    alpha = channels["A"].astype(np.float32) if "A" in channels else None
    pixels = np.stack([channels[name].astype(np.float32) for name in names], axis=2)
    if alpha is not None:  # colours are multiplied by alpha ("Technical Introduction to OpenEXR")
        pixels /= np.where(alpha > 0, alpha, 1)[..., None]
    return Decoded(
        pixels,
        alpha,
        FileInfo("exr", 16 if is_half else 32, primaries=primaries, header=attributes),
    )


def write_exr(image: Decoded) -> bytes:
    """Encodes an EXR in half (16 `bits`) or single precision (32 `bits`), with the attributes of
    the source.
    """
    exr = library_of("exr")
    names = "RGB" if image.pixels.shape[2] == 3 else "Y"
    alpha = image.alpha
    pixels = (
        image.pixels if alpha is None else image.pixels * np.where(alpha > 0, alpha, 1)[..., None]
    )
    planes = {name: pixels[..., i] for i, name in enumerate(names)}
    if alpha is not None:
        planes["A"] = alpha
    header = {
        "compression": exr.ZIP_COMPRESSION,
        **(image.file_info.header or {}),
        **({"software": image.file_info.software} if image.file_info.software else {}),
        "type": exr.scanlineimage,
    }
    return _exr_bytes(planes, np.float16 if image.file_info.bits == 16 else np.float32, header)


_LAYER_CHANNELS = ("R", "G", "B")
_OF_THE_FILE = ("channels", "tiles", "type", "name", "chunkCount", "preview")
"""Attributes that describe the stored image. A preview shows the input."""
_RESERVED_ATTRIBUTES = {
    *[
        "channels",
        "chunkCount",
        "compression",
        "dataWindow",
        "lineOrder",
        "tiles",
        "type",
        "version",
    ]
}
"""Attributes that OpenEXR defines. It drops text attributes with some of these names without an
error.
"""


def write_exr_layers(layers: Mapping[str, Float32], header: Mapping[str, str]) -> bytes:
    """Encodes images (H, W, 3) of equal size as the layers of one EXR, in half precision, with text
    attributes.

    The red channel of the layer "photo" has the name "photo.R", as compositing programs expect
    ("Technical Introduction to OpenEXR", layers). Values are clipped to the range of half
    precision, -65504..65504.

    Args:
        layers: linear light (H, W, 3) float32 by the name of the layer.
        header: text attributes by name.

    Raises:
        MissingExtra: OpenEXR is not installed.
        UnsupportedPhoto: OpenEXR reserves the name of an attribute.
    """
    exr = library_of("exr")
    if reserved := _RESERVED_ATTRIBUTES & header.keys():
        raise UnsupportedPhoto(
            f"attributes have the names {', '.join(sorted(reserved))}",
            "expected other names, because these are reserved by OpenEXR",
            "choose other names",
        )
    channels = [*enumerate(_LAYER_CHANNELS)]
    planes = {
        f"{name}.{channel}": layer[..., i]
        for name, layer in layers.items()
        for i, channel in channels
    }
    attributes = {**header, "compression": exr.ZIP_COMPRESSION, "type": exr.scanlineimage}
    return _exr_bytes(planes, np.float16, attributes)


def _exr_bytes(
    planes: Mapping[str, Float32], dtype: type[np.floating[Any]], header: dict[str, Any]
) -> bytes:
    max_value = float(np.finfo(dtype).max)
    file = io.BytesIO()
    channels = {
        name: np.ascontiguousarray(plane.clip(-max_value, max_value).astype(dtype))
        for name, plane in planes.items()
    }
    library_of("exr").File(header, channels).write(file)
    return file.getvalue()


def read_exr_layers(data: bytes) -> dict[str, Float32]:
    """Returns the layers of an EXR by name, (H, W, 3) float32 each, sorted by name, without other
    channels.

    Args:
        data: the bytes of the file.

    Raises:
        MissingExtra: OpenEXR is not installed.
        UnreadablePhoto: the file has no layer, or is damaged.
    """
    channels = _exr_parts(data, header_only=False)[0].channels
    stems = sorted(name.removesuffix(".R") for name in channels if name.endswith(".R"))
    layers = {}
    for stem in stems:
        names = [f"{stem}.{channel}" for channel in _LAYER_CHANNELS]
        if channels.keys() >= {*names}:
            layers[stem] = np.stack(
                [channels[name].pixels.astype(np.float32) for name in names], axis=2
            )
    if not layers:
        raise UnreadablePhoto(
            f"the EXR has the channels {', '.join(sorted(channels))}",
            'expected channels with names such as "name.R", "name.G" and "name.B"',
            "open the file with Photo.open, or write it again",
        )
    return layers


# --- Radiance HDR (G. Ward, "Real Pixels", Graphics Gems II; the RADIANCE reference manual)

_FACTORS = ("EXPOSURE", "COLORCORR", "PIXASPECT")
"""Attributes that are factors: if a header repeats one of them, its value is the product ("Radiance
File Formats").
"""


def read_hdr(data: bytes, max_pixels: int) -> Decoded:
    """Reads a Radiance HDR image: red, green and blue with a shared exponent (RGBE). Raises
    PhotoTooLarge if the image has more pixels than `max_pixels`; UnreadablePhoto if the image is
    empty or truncated; UnsupportedPhoto if the image has XYZ colours, its scan lines are not
    ordered from top to bottom, or its header has no size.
    """
    if b"\r\n" in data[: data.find(b"\n") + 1]:
        raise UnsupportedPhoto(
            "the lines in the header of the HDR image end in CR LF, so a program has changed the "
            "file as if it were text",
            "expected lines that end in LF",
            "copy the file again as binary data, or export the image again",
        )
    header_text, separator, rest = data.partition(b"\n\n")
    resolution, _, body = rest.partition(b"\n")
    resolution_match = re.fullmatch(rb"-Y (\d{1,9}) \+X (\d{1,9})\s*", resolution)
    lines = header_text.decode("latin-1").splitlines()[1:]
    if any(line.startswith("FORMAT=") and "xyze" in line for line in lines):
        happened = "the HDR image has XYZ colours (FORMAT=32-bit_rle_xyze)"
        raise UnsupportedPhoto(happened, "expected RGBE colours", "export the image as RGBE")
    has_order = re.fullmatch(rb"([+-][XY]) \d+ ([+-][XY]) \d+\s*", resolution)
    if has_order and has_order.groups() != (b"-Y", b"+X"):
        raise UnsupportedPhoto(
            f"the HDR image is stored mirrored or rotated ({resolution.decode().strip()!r})",
            "expected scan lines from top to bottom, and from left to right: '-Y height +X width'",
            "export the image in this order",
        )
    if not separator or resolution_match is None:
        raise UnsupportedPhoto(
            f"the header of the HDR image ends in {resolution[:40]!r}",
            "expected an RGBE image with scan lines from top to bottom, '-Y height +X width'",
            "export the image in this form",
        )
    height, width = int(resolution_match[1]), int(resolution_match[2])
    if width * height == 0:
        happened = f"the HDR image has {width} x {height} pixels"
        raise UnreadablePhoto(happened, "expected at least one pixel", "export the image again")
    check_pixel_count(width, height, max_pixels)
    header: dict[str, str] = {}
    for line in lines:
        key, equals_sign, value = line.partition("=")
        if equals_sign and not line.startswith("FORMAT"):
            header[key] = (
                _product(header[key], value) if key in _FACTORS and key in header else value
            )
    primaries = valid_chromaticities(header.get("PRIMARIES", "").split())
    file_info = FileInfo("hdr", bits=32, header=header, primaries=primaries)
    rgbe = _scan_lines(body, width, height)
    exponent = rgbe[..., 3].astype(np.int32)
    scale = np.where(exponent > 0, np.ldexp(np.float32(1), exponent - 136), np.float32(0)).astype(
        np.float32
    )
    return Decoded(rgbe[..., :3].astype(np.float32) * scale[..., None], None, file_info)


def _product(first: str, second: str) -> str:
    """Returns the products of the numbers of two attributes, or the second attribute if they are
    not numbers.
    """
    try:
        products = [float(a) * float(b) for a, b in zip(first.split(), second.split(), strict=True)]
    except ValueError:
        return second
    return " ".join(f"{product:.9g}" for product in products)


def _scan_lines(body: bytes, width: int, height: int) -> NDArray[np.uint8]:
    """Reads RGBE (H, W, 4): run-length encoded, or flat or in old runs (always if 2**15 px
    wide).
    """
    is_run_length_encoded = width < 1 << 15 and body.startswith(b"\2\2" + width.to_bytes(2, "big"))
    try:
        if is_run_length_encoded:
            planes = np.frombuffer(_decode_runs(body, width, height), np.uint8)
            return planes.reshape(height, 4, width).swapaxes(1, 2)
        if len(body) < height * width * 4:
            body = _decode_old_runs(body, height * width)
        return np.frombuffer(body, np.uint8, height * width * 4).reshape(height, width, 4)
    except (IndexError, ValueError) as error:
        raise UnreadablePhoto(
            "the HDR image cannot be read completely (it is truncated or damaged)",
            f"expected {height} lines, as its header states",
            "copy the file again from its source",
        ) from error


def _decode_runs(body: bytes, width: int, height: int) -> bytes:
    """A line has a header of 4 bytes, runs (128 + length, value) and literals (length,
    values...).
    """
    planes = bytearray()
    position = 0
    for line in range(height):
        position += 4
        end = 4 * width * (line + 1)
        while len(planes) < end:
            run = body[position]
            size = 1 if run > 128 else run
            planes += body[position + 1 : position + 1 + size] * (run - 128 if run > 128 else 1)
            position += 1 + size
    return bytes(planes)


def _decode_old_runs(body: bytes, count: int) -> bytes:
    """Of Radiance 1.4: (1, 1, 1, n) repeats a pixel n times, the k-th in a row n * 256**(k-1)
    times.
    """
    pixels = np.frombuffer(body, np.uint8, len(body) // 4 * 4).reshape(-1, 4)
    is_run = (pixels[:, :3] == 1).all(axis=1)
    positions = np.arange(len(pixels))
    last_literal = np.maximum.accumulate(np.where(is_run, -1, positions))
    shifts = np.minimum(8 * (positions - last_literal - 1), 24)
    repeats = np.where(is_run, pixels[:, 3].astype(np.int64) << shifts, 1)
    if last_literal[:1].tolist() != [0] or repeats.sum() != count:
        raise ValueError
    return np.repeat(pixels[last_literal], repeats, axis=0).tobytes()


def write_hdr(image: Decoded) -> bytes:
    """Encodes a Radiance HDR image with flat lines, which all readers support. Grey becomes three
    equal channels. For light from `read_hdr`, the values are exactly those that were read. Negative
    light becomes black.
    """
    height, width = image.pixels.shape[:2]
    header = dict(image.file_info.header or {})
    if image.file_info.software:
        header["SOFTWARE"] = image.file_info.software
    attributes = [f"{key}={value}" for key, value in header.items()]
    lines = ["#?RADIANCE", "FORMAT=32-bit_rle_rgbe", *attributes]
    head = "\n".join(lines) + f"\n\n-Y {height} +X {width}\n"
    light = np.fmax(np.broadcast_to(image.pixels, (height, width, 3)), 0)
    _, exponent = np.frexp(light.max(axis=2))
    exponent = np.clip(exponent, -127, 127)
    mantissa = np.floor(np.ldexp(light, (8 - exponent)[..., None]) + 0.5).clip(0, 255)
    rgbe = np.concatenate([mantissa, (exponent + 128)[..., None]], axis=2).astype(np.uint8)
    rgbe[mantissa.max(axis=2) == 0] = 0
    return head.encode("latin-1") + rgbe.tobytes()
