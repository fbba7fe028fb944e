"""Photos with a film, in the layouts of the makers. The pictures and the films are our own."""

import io
import struct
import zipfile
from xml.sax.saxutils import quoteattr

import numpy as np
import pillow_heif
from PIL import Image

from picture_files import smooth
from video_files import film_of, write_video

IDENTIFIER = "0F3A7C52-1D2E-4B6F-9A80-5C4D3E2F1A0B"
_IDENTIFIER_KEY = "com.apple.quicktime.content.identifier"


def small_film(path, count=6, size=(64, 48), identifier=None, **options):
    """Writes a film of a few frames, and returns its bytes."""
    picture = np.tile(smooth(240, 320), (2, 2, 1))
    if identifier is None:
        write_video(path, film_of(picture, count, size), **options)
    else:
        _write_with_identifier(path, film_of(picture, count, size), identifier)
    return path.read_bytes()


def _write_with_identifier(path, frames, identifier):
    import av  # noqa: PLC0415

    with av.open(str(path), "w", options={"movflags": "use_metadata_tags"}) as container:
        container.metadata[_IDENTIFIER_KEY] = identifier
        stream = container.add_stream("mpeg4", rate=30)
        stream.height, stream.width = frames[0].shape[:2]
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())


# --- Stills


def jpeg(xmp=None, exif=None, size=(64, 48), quality=90):
    """Returns a JPEG that PIL writes."""
    file = io.BytesIO()
    blocks = {"xmp": xmp} if xmp else {}
    image = Image.fromarray(smooth(*reversed(size)))
    image.save(file, "JPEG", quality=quality, exif=exif or b"", **blocks)
    return file.getvalue()


def heic(xmp=None, exif=None):
    """Returns a HEIC that libheif writes."""
    file = io.BytesIO()
    image = pillow_heif.from_pillow(Image.fromarray(smooth(64, 64)))
    image.save(file, quality=50, xmp=xmp, exif=exif)
    return file.getvalue()


def apple_exif(identifier=IDENTIFIER):
    """Returns an EXIF block with a maker note of Apple: a directory of TIFF with positions from its
    start.
    """
    text = identifier.encode() + b"\0"
    head = b"Apple iOS\0\0\1MM"
    position = len(head) + 2 + 2 * 12 + 4
    rows = struct.pack(">HHIi", 0x0001, 9, 1, 14)  # the version of the note
    rows += struct.pack(">HHII", 0x0011, 2, len(text), position)
    note = head + struct.pack(">H", 2) + rows + bytes(4) + text
    exif = Image.Exif()
    exif.endian = ">"
    exif[271] = "Apple"
    exif.get_ifd(34665)[37500] = note
    return exif.tobytes()


# --- XMP


def packet(properties, body="", namespaces=None):
    """Returns an XMP packet with these attributes (name with prefix: value) and elements."""
    names = {
        "GCamera": "http://ns.google.com/photos/1.0/camera/",
        "OpCamera": "http://ns.oplus.com/photos/1.0/camera/",
        **(namespaces or {}),
    }
    declared = " ".join(f"xmlns:{prefix}={quoteattr(name)}" for prefix, name in names.items())
    values = " ".join(f"{name}={quoteattr(str(value))}" for name, value in properties.items())
    return (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/">'
        '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        f'<rdf:Description rdf:about="" {declared} {values}>{body}</rdf:Description>'
        "</rdf:RDF></x:xmpmeta>"
    ).encode()


def container(*items, prefix="Container", item_prefix="Item", as_elements=False):
    """Returns the directory of the Google container: items of type, semantic, length, padding."""
    names = (
        f'xmlns:{prefix}="http://ns.google.com/photos/1.0/container/" '
        f'xmlns:{item_prefix}="http://ns.google.com/photos/1.0/container/item/"'
    )
    rows = []
    for values in items:
        pairs = dict(zip(("Mime", "Semantic", "Length", "Padding"), values, strict=True))
        if as_elements:
            inside = "".join(
                f"<{item_prefix}:{name}>{value}</{item_prefix}:{name}>"
                for name, value in pairs.items()
            )
            item = f'<{prefix}:Item rdf:parseType="Resource">{inside}</{prefix}:Item>'
        else:
            inside = " ".join(f'{item_prefix}:{name}="{value}"' for name, value in pairs.items())
            item = f"<{prefix}:Item {inside}/>"
        rows.append(f'<rdf:li rdf:parseType="Resource">{item}</rdf:li>')
    return f"<{prefix}:Directory {names}><rdf:Seq>{''.join(rows)}</rdf:Seq></{prefix}:Directory>"


MOTION_PHOTO = {
    "GCamera:MotionPhoto": 1,
    "GCamera:MotionPhotoVersion": 1,
    "GCamera:MotionPhotoPresentationTimestampUs": 100000,
}


def google_xmp(film_length, *others, padding=0, primary=0, mime="image/jpeg", **options):
    """Returns the packet of a Pixel. `others` are items before the film."""
    items = [
        (mime, "Primary", primary, padding),
        *others,
        ("video/mp4", "MotionPhoto", film_length, 0),
    ]
    return packet(MOTION_PHOTO, container(*items, **options))


# --- Blocks of the makers


def samsung_block(*entries):
    """Returns Samsung's extended format: entries (type, name, content), then their directory."""
    rows = b""
    data = b""
    for kind, name, content in entries:
        block = struct.pack("<HHI", 0, kind, len(name)) + name + content
        data += block
        rows += struct.pack("<HHII", 0, kind, len(data), len(block))
    # positions count backwards from the directory
    fixed = b""
    for start in range(0, len(rows), 12):
        zero, kind, end, size = struct.unpack("<HHII", rows[start : start + 12])
        fixed += struct.pack("<HHII", zero, kind, len(data) - end + size, size)
    directory = b"SEFH" + struct.pack("<II", 107, len(entries)) + fixed
    return data + directory + struct.pack("<I", len(directory)) + b"SEFT"


UTC_ENTRY = (0x0A01, b"Image_UTC_Data", b"1700000000000")


def film_entry(content):
    return (0x0A30, b"MotionPhoto_Data", content)


def box(kind, content, *, is_wide=False):
    """Returns a box with a header of 8 or, `is_wide`, 16 bytes."""
    if is_wide:
        return struct.pack(">I4sQ", 1, kind, 16 + len(content)) + content
    return struct.pack(">I4s", 8 + len(content), kind) + content


def huawei_tail(film, *, version=b"v2_f35", extra=b""):
    """Returns what follows the film in a file of Huawei. Old files have no version."""
    fields = [version.ljust(20)] if version else []
    length = len(film) + len(extra) + 20 * len(fields)
    fields += [b"1000:2345".ljust(20), b"LIVE_%d" % length]
    return extra + b"".join(fields[:-1]) + fields[-1].ljust(20)


def live_photo_archive(files, *, is_compressed=False):
    """Returns a .livp file with these files, name: content."""
    file = io.BytesIO()
    method = zipfile.ZIP_DEFLATED if is_compressed else zipfile.ZIP_STORED
    with zipfile.ZipFile(file, "w", method) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return file.getvalue()
