"""Records the program that created a layer, and its options, in the metadata of the layer: XMP
history, EXIF Software.

The XMP block of a camera or an editor is kept, and an entry is added to it. The entry has no date,
so that the same input gives the same bytes. XMP: ISO 16684-1, and part 2 of the XMP specification
(xmpMM:History, stEvt:*).
"""

import html
import re
import struct
from collections.abc import Iterable, Mapping
from dataclasses import replace
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import Final

import brewster
from brewster.base.image_formats import is_video
from brewster.photo.blocks.tiff_tags import first_directory
from brewster.photo.blocks.xmp import RDF_END
from brewster.photo.file_info import FileInfo, sampled_digest
from brewster.photo.metadata import read_xmp
from brewster.photo.photo import Photo

PROGRAM: Final = "brewster"
"""The name under which the metadata of images record this program."""
PHOTO: Final = "photo"
"""The name of the parameter that identifies the photo of a layer: its `sampled_digest`."""
_EXIF_SOFTWARE = 305
_MAX_EXIF_BYTES = 65527  # a JPEG segment of 65533 bytes without the name of the block
_PACKET = """<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>
<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description rdf:about="" xmlns:xmp="http://ns.adobe.com/xap/1.0/" xmp:CreatorTool={software}/>
</rdf:RDF></x:xmpmeta>
<?xpacket end="w"?>"""
_HISTORY = """\
<rdf:Description xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#" rdf:about={about} \
xmlns:xmpMM="http://ns.adobe.com/xap/1.0/mm/"><xmpMM:History><rdf:Seq>
{entry}</rdf:Seq></xmpMM:History></rdf:Description>
"""
_ENTRY = (
    '<rdf:li xmlns:stEvt="http://ns.adobe.com/xap/1.0/sType/ResourceEvent#" stEvt:action="derived" '
    "stEvt:softwareAgent={software} stEvt:parameters={parameters}/>"
)


def with_history(file_info: FileInfo, software: str, parameters: Mapping[str, str]) -> FileInfo:
    """Returns the metadata of an input with an entry about a processing step: the program with its
    version, and the options by name. Names and values contain neither "; " nor "=".
    """
    text = "; ".join(f"{name}={value}" for name, value in parameters.items())
    entry = _ENTRY.format(software=_attribute(software), parameters=_attribute(text)).encode()
    packet = file_info.xmp or b""
    if not RDF_END.search(packet):  # there is none, or it is damaged
        packet = _PACKET.format(software=_attribute(software)).encode()
    exif = file_info.exif and _with_exif_software(file_info.exif, software)
    if history := re.search(
        rb"<xmpMM:History>(?:(?!</xmpMM:History>).)*(?=</rdf:Seq>)", packet, re.DOTALL
    ):
        packet = packet[: history.end()] + entry + packet[history.end() :]
    else:
        end = [*RDF_END.finditer(packet)][-1].start()
        # all descriptions are of the same resource
        about = re.search(rb"""rdf:about=("[^"]*"|'[^']*')""", packet)
        block = (
            _HISTORY.encode()
            .replace(b"{about}", about[1] if about else b'""')
            .replace(b"{entry}", entry)
        )
        packet = packet[:end] + block + packet[end:]
    return replace(file_info, xmp=packet, exif=exif, software=software)


def _attribute(text: str) -> str:
    """Returns a text as an XML attribute. `xml.sax.saxutils` would import `urllib` and `ssl`."""
    escaped = html.escape(text, quote=False).replace('"', "&quot;")
    return f'"{escaped}"'


def with_layer_history(photo: Photo, layer: str, parameters: Mapping[str, str]) -> Photo:
    """Returns a layer with the history of this program and version. The first parameter is the name
    of the layer.
    """
    software = f"{PROGRAM} {brewster.__version__}"
    parameters = {"layer": layer, **parameters}
    return replace(photo, file_info=with_history(photo.file_info, software, parameters))


def separation_parameters(
    *, strength: float, quality: str, additive: bool, mask: object, hints: object
) -> dict[str, str]:
    """Returns the options of a separation as names and values for the metadata of its layers."""
    given = {"additive": additive, "mask": mask is not None, "hints": hints is not None}
    flags = {name: "yes" if value else "no" for name, value in given.items()}
    return {"strength": f"{strength:g}", "quality": quality} | flags


def recorded_parameters(path: Path, program: str) -> dict[str, str] | None:
    """Returns the parameters of the last step of a program in the history of a file, or None if
    there is no such step, as in videos. Of large files, only the metadata are read, except of AVIF
    and HEIC.
    """
    if is_video(path):
        return None
    try:
        with path.open("rb") as file, mmap(file.fileno(), 0, access=ACCESS_READ) as data:
            packets = [data[:]] if data[4:8] == b"ftyp" else read_xmp(data)
            return _last_parameters(b"".join(packets), program)
    except (OSError, ValueError):  # the file is empty
        return None


def find_layer_of_another_photo(photo: Path, layers: Iterable[Path]) -> Path | None:
    """Returns a layer that was made from another photo, or from another version of this photo.
    Otherwise returns None.

    The first layer that records its photo decides, and the other layers are not read. A layer
    without this record is accepted: it is from an earlier version of brewster, or its format has no
    XMP. None for an unreadable photo.
    """
    for layer in layers:
        recorded = (recorded_parameters(layer, PROGRAM) or {}).get(PHOTO)
        if recorded:
            try:
                with photo.open("rb") as file:
                    return None if sampled_digest(file) == recorded else layer
            except OSError:
                return None
    return None


def _last_parameters(data: bytes, program: str) -> dict[str, str] | None:
    agent = re.escape(program.encode())
    found = re.findall(
        rb'stEvt:softwareAgent="' + agent + rb' [^"]*" stEvt:parameters="([^"]*)"', data
    )
    if not found:
        return None
    parameters = html.unescape(found[-1].decode("utf-8", "replace")).split("; ")
    return dict(part.split("=", 1) for part in parameters if "=" in part)


def _with_exif_software(exif: bytes, software: str) -> bytes:
    """Sets the tag Software of an EXIF block. All existing bytes keep their positions. The
    directory with the new tag is appended, and the offset of the first directory is set to it.
    Therefore the offsets in maker notes stay valid. A damaged block is returned unchanged, and so
    is a block that becomes too large for a JPEG.
    """
    byte_order, first_row, end = first_directory(exif)
    if end == first_row or end + 4 > len(exif):
        return exif
    rows = [exif[row : row + 12] for row in range(first_row, end, 12)]
    value = software.encode("ascii", "replace") + b"\0"
    start = len(exif) + len(exif) % 2
    rows = [row for row in rows if struct.unpack_from(byte_order + "H", row) != (_EXIF_SOFTWARE,)]
    rows.append(struct.pack(byte_order + "HHII", _EXIF_SOFTWARE, 2, len(value), start))
    rows.sort(key=lambda row: struct.unpack_from(byte_order + "H", row))
    directory = start + len(value) + len(value) % 2
    head = exif[:4] + struct.pack(byte_order + "I", directory) + exif[8:].ljust(start - 8, b"\0")
    count = struct.pack(byte_order + "H", len(rows))
    changed = b"".join(
        (head, value.ljust(directory - start, b"\0"), count, *rows, exif[end : end + 4])
    )
    fits = len(changed) <= _MAX_EXIF_BYTES or len(exif) > _MAX_EXIF_BYTES
    return changed if fits else exif
