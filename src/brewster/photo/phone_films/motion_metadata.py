"""What the metadata of a photo state about its film: EXIF and XMP of JPEG, HEIC and AVIF files.

Names of properties are compared with their namespaces, because writers choose other prefixes. What
the values state is often out of date, see `brewster.photo.phone_films.motion_photo`.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from typing import BinaryIO, Final, final
from xml.dom.minidom import Document, Element

from brewster.photo.blocks.iso_boxes import item_contents
from brewster.photo.blocks.jpeg_segments import APP1, START_OF_SCAN, XMP_NAME, jpeg_segments
from brewster.photo.blocks.tiff_tags import EXIF_NAME, EXIF_POINTER, Tags, read_tags, value_of
from brewster.photo.blocks.xmp import parse_packet

_CAMERA: Final = "http://ns.google.com/photos/1.0/camera/"
_CONTAINER: Final = "http://ns.google.com/photos/1.0/container/"
_ITEM: Final = "http://ns.google.com/photos/1.0/container/item/"
_OPPO: Final = "http://ns.oplus.com/photos/1.0/camera/"
_STILL_TIMES: Final = (
    (_CAMERA, "MotionPhotoPresentationTimestampUs"),
    (_CAMERA, "MicroVideoPresentationTimestampUs"),
    (_OPPO, "MotionPhotoPrimaryPresentationTimestampUs"),
)
"""The properties with the time of the still in microseconds; negative: not stated."""
_XMP_WORDS: Final = (b"MotionPhoto", b"MicroVideo", b"photos/1.0/container")
_MAX_ITEMS: Final = 64
_MAKER_NOTE: Final = 37500
_APPLE_NOTE: Final = b"Apple iOS\0\0\1MM"
_APPLE_IDENTIFIER: Final = 0x0011


@final
@dataclass(frozen=True)
class ContainerItem:
    """A part of the file in the directory of the Google container, in the order of the file."""

    mime_type: str
    semantic: str
    length: int
    padding: int

    @property
    def is_film(self) -> bool:
        """Whether the part is a film."""
        return self.semantic == "MotionPhoto" or self.mime_type.startswith("video/")


@final
@dataclass(frozen=True)
class MotionMetadata:
    """What the metadata of a photo state about its film. Nothing in it is certain."""

    is_motion_photo: bool = False
    """Whether the photo is said to have a film."""
    items: tuple[ContainerItem, ...] = ()
    micro_video_offset: int = 0
    """The distance of the film from the end of the file, in bytes; 0: not stated."""
    still_time_s: float | None = None
    """When the still was taken, in seconds of the film; None: not stated."""
    has_oppo_properties: bool = False
    content_identifier: str | None = None
    """The identifier that a Live Photo of Apple shares with its film."""
    pixels_start: int = 0
    """Where the compressed pixels of a JPEG begin; 0: another format."""


def read_motion_metadata(file: BinaryIO, format_name: str) -> MotionMetadata:
    """Reads the metadata of a file of this format, a key of `FORMATS`. Damaged blocks are
    ignored.
    """
    pixels_start = 0
    blocks = dict[str, bytes]()
    if format_name == "jpeg":
        blocks, pixels_start = _jpeg_blocks(file)
    elif format_name in ("heic", "avif"):
        blocks = item_contents(file, file.seek(0, 2))
    identifier = content_identifier(blocks.get("Exif", b""))
    packet = blocks.get("XMP", b"")
    is_about_film = any(word in packet for word in _XMP_WORDS)
    document = parse_packet(packet) if is_about_film else None
    if document is None:
        return MotionMetadata(content_identifier=identifier, pixels_start=pixels_start)
    values = dict(_properties(document))
    items = tuple(islice(_container_items(document), _MAX_ITEMS))
    flags = (values.get((_CAMERA, name)) for name in ("MotionPhoto", "MicroVideo"))
    return MotionMetadata(
        "1" in flags or any(item.is_film for item in items),
        items,
        _number(values.get((_CAMERA, "MicroVideoOffset"))),
        _still_time_s(values),
        any(namespace == _OPPO for namespace, _ in values),
        identifier,
        pixels_start,
    )


def _jpeg_blocks(file: BinaryIO) -> tuple[dict[str, bytes], int]:
    """Returns the EXIF and XMP blocks of a JPEG, and where its compressed pixels begin."""
    blocks = dict[str, bytes]()
    pixels_start = 2
    for segment in jpeg_segments(file):
        if segment.marker == START_OF_SCAN:
            return blocks, segment.start
        pixels_start = segment.start + 4 + len(segment.payload)
        if segment.marker == APP1:
            for name, prefix in (("Exif", EXIF_NAME), ("XMP", XMP_NAME)):
                if segment.payload.startswith(prefix):
                    blocks.setdefault(name, segment.payload[len(prefix) :])
    return blocks, pixels_start


def content_identifier(exif: bytes) -> str | None:
    """Returns the identifier of a Live Photo in the maker note of an EXIF block of Apple, or None.

    The maker note is a directory of TIFF after 14 bytes, with positions that count from its start.
    """
    camera = read_tags(exif).get(EXIF_POINTER)
    note = value_of(camera, _MAKER_NOTE) if isinstance(camera, dict) else None
    if not note or not note.startswith(_APPLE_NOTE):
        return None
    first = len(_APPLE_NOTE)
    tags: Tags = read_tags(b"MM\0*" + first.to_bytes(4, "big") + note[8:])
    text = (value_of(tags, _APPLE_IDENTIFIER) or b"").rstrip(b"\0 ")
    return text.decode("ascii", "replace") or None


def _properties(document: Document) -> Iterator[tuple[tuple[str, str], str]]:
    """Yields (namespace, name) and the text of all attributes and elements without children."""
    for element in document.getElementsByTagName("*"):
        for attribute in (element.attributes or {}).values():
            yield _key(attribute), attribute.value
        text = element.firstChild
        if text is not None and text.nodeType == text.TEXT_NODE and len(element.childNodes) == 1:
            yield _key(element), text.data.strip()


def _key(node: object) -> tuple[str, str]:
    return getattr(node, "namespaceURI", None) or "", getattr(node, "localName", None) or ""


def _container_items(document: Document) -> Iterator[ContainerItem]:
    for directory in document.getElementsByTagNameNS(_CONTAINER, "Directory"):
        for element in directory.getElementsByTagNameNS("*", "li"):
            values = _item_values(element)
            yield ContainerItem(
                values.get("Mime", ""),
                values.get("Semantic", ""),
                _number(values.get("Length")),
                _number(values.get("Padding")),
            )


def _item_values(element: Element) -> dict[str, str]:
    """Returns the properties of an item, whether they are attributes or elements, of the list entry
    or of the item in it.
    """
    values = dict[str, str]()
    for part in (element, *element.getElementsByTagName("*")):
        for attribute in (part.attributes or {}).values():
            if attribute.namespaceURI == _ITEM:
                values[attribute.localName] = attribute.value
        if part.namespaceURI == _ITEM and part.firstChild is not None:
            values[part.localName] = getattr(part.firstChild, "data", "").strip()
    return values


def _still_time_s(values: dict[tuple[str, str], str]) -> float | None:
    for key in _STILL_TIMES:
        text = values.get(key, "")
        if text.isdecimal() and len(text) < 16:
            return int(text) / 1e6
    return None


def _number(text: str | None) -> int:
    return int(text) if text and text.isdecimal() and len(text) < 16 else 0
