"""Edits XMP packets (ISO 16684-1; extended XMP of JPEG: XMP specification, part 3).

A packet is changed as text where possible, so that all other bytes stay. What it promises about
parts of the file that layers do not have is removed: gain maps, films, other images, thumbnails of
the input.
"""

import hashlib
import re
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Final
from xml.dom.minidom import Attr, Document, Element, Node, parseString
from xml.parsers.expat import ExpatError

RDF_END: Final = re.compile(rb"</(?:[\w.-]+:)?RDF\s*>")
"""The end of the properties. A packet without it is damaged."""
_PACKET: Final = '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>{}<?xpacket end="w"?>'
_RDF: Final = "http://www.w3.org/1999/02/22-rdf-syntax-ns#"
_XMLNS: Final = "http://www.w3.org/2000/xmlns/"
_NOTE: Final = "http://ns.adobe.com/xmp/note/"
_PROMISES: Final = re.compile(
    "http://ns.adobe.com/hdr-gain-map/.*|http://ns.apple.com/HDRGainMap/.*"
    "|http://ns.google.com/photos/(?:1.0/container|dd/1.0)/.*|.* (?:MotionPhoto|MicroVideo).*"
    f"|{_NOTE} HasExtendedXMP|http://ns.adobe.com/xap/1.0/ Thumbnails|http://purl.org/dc/terms/ "
    "provenance"
)
"""Namespace and name of the properties about parts of the file that layers do not have."""
_PROMISE_WORDS: Final = re.compile(
    rb"hdr-gain-map|HDRGainMap|photos/1.0/container|photos/dd/|MotionPhoto|MicroVideo|HasExtendedXMP|:Thumbnails|"
    rb":provenance"
)
GAIN_MAP: Final = "gain map (HDR)"
FILM: Final = "film (motion photo)"
_MAX_DEPTH: Final = 64
_SIZE_NAMES: Final = (
    rb"tiff:ImageWidth|exif:PixelXDimension",
    rb"tiff:ImageLength|exif:PixelYDimension",
)


def layer_xmp(packets: Sequence[bytes], size: tuple[int, int]) -> tuple[bytes | None, list[str]]:
    """Returns the XMP packet for layers of this (width, height), and the names of what is lost.

    `packets` are the main packet of a file and, for a JPEG, its extended packet; the result
    contains both. Without a packet, the result is None.
    """
    if not packets:
        return None, []
    main = _upright(_as_utf8(packets[0]), size)
    lost = _lost_parts(b"".join(packets))
    extensions = [parsed for packet in packets[1:] if (parsed := parse_packet(_as_utf8(packet)))]
    if b"HasExtendedXMP" in main and not extensions:
        lost.append("extended XMP, which is missing or damaged")
    if RDF_END.search(main) and len(packets) == 1 and not _PROMISE_WORDS.search(main):
        return main, lost
    document = parse_packet(main) if RDF_END.search(main) else None
    if document is None:
        return None if _PROMISE_WORDS.search(main) else main, [*lost, "XMP, which is damaged"]
    for extension in extensions:
        _merge(document, extension)
    for element in [*document.getElementsByTagName("*")]:
        for attribute in _attributes(element):
            is_declaration = attribute.namespaceURI == _XMLNS
            if _PROMISES.fullmatch(f"{attribute.value} " if is_declaration else _name(attribute)):
                element.removeAttributeNode(attribute)
        if _PROMISES.fullmatch(_name(element)) and element.parentNode:
            element.parentNode.removeChild(element)
    return _serialise(document), lost


def split_xmp(packet: bytes, limit: int) -> tuple[bytes, bytes]:
    """Returns a packet of at most `limit` bytes, and no bytes or the extended packet, to which the
    first one refers. The largest properties are in the extended packet. Both are empty if the
    packet is too large and damaged.
    """
    if len(packet) <= limit:
        return packet, b""
    main = parse_packet(packet)
    extension = parse_packet(packet)
    if main is None or extension is None:
        return b"", b""
    pairs = zip(_properties(main), _properties(extension), strict=True)
    excess = len(_serialise(main)) + 256 - limit
    for (size, remove_main), (_, remove_extension) in sorted(pairs, key=lambda pair: -pair[0][0]):
        (remove_main if excess > 0 else remove_extension)()
        excess -= size
    extended = _serialise(extension)
    note = main.createElementNS(_RDF, "rdf:Description")
    names = {
        "xmlns:rdf": _RDF,
        "rdf:about": "",
        "xmlns:xmpNote": _NOTE,
        "xmpNote:HasExtendedXMP": guid_of(extended),
    }
    for name, value in names.items():
        note.setAttribute(name, value)
    _rdf(main).appendChild(note)
    return _serialise(main), extended


def guid_of(extended: bytes) -> str:
    """Returns the digest by which the main packet refers to an extended packet."""
    return hashlib.md5(extended, usedforsecurity=False).hexdigest().upper()


def _upright(packet: bytes, size: tuple[int, int]) -> bytes:
    """Sets tiff:Orientation to 1, and the size to that of the upright image. All other bytes are
    unchanged.
    """
    for names, value in zip((rb"tiff:Orientation", *_SIZE_NAMES), (1, *size), strict=True):
        packet = re.sub(rb"((?:%s)(?:=[\"']|>))\d+" % names, rb"\g<1>%d" % value, packet)
    return packet


def _lost_parts(packets: bytes) -> list[str]:
    """Returns the names of the parts of a file that its XMP describes, except the image itself."""
    parts = {
        name.decode(): name.decode() for name in re.findall(rb"Semantic(?:=[\"']|>)(\w+)", packets)
    }
    is_gain_map = "GainMap" in parts or re.search(
        rb"ns.adobe.com/hdr-gain-map/|ns.apple.com/HDRGainMap/", packets
    )
    is_film = "MotionPhoto" in parts or re.search(
        rb"(?:MotionPhoto|MicroVideo)(?:=[\"']|>)1", packets
    )
    others = sorted(parts.keys() - {"Primary", "GainMap", "MotionPhoto"})
    return [
        name for name, is_lost in ((GAIN_MAP, is_gain_map), (FILM, is_film)) if is_lost
    ] + others


def _as_utf8(packet: bytes) -> bytes:
    packet = packet.rstrip(b"\0") if packet[1:2] != b"\0" else packet
    encoding = {b"<\0": "utf-16-le", b"\0<": "utf-16-be"}.get(packet[:2])
    return packet.decode(encoding, "replace").encode(errors="replace") if encoding else packet


def parse_packet(packet: bytes) -> Document | None:
    """Returns the document of a packet, or None for a damaged packet. Entities are refused, because
    they can expand to a very large text.
    """
    try:
        has_entities = re.search(rb"<!(?:DOCTYPE|ENTITY)", packet)
        document = None if has_entities else parseString(packet.strip(b"\0 \r\n\t"))  # noqa: S318
    except (ExpatError, ValueError):
        return None
    if document is None or _is_deep(document):
        return None
    return document if document.getElementsByTagNameNS(_RDF, "RDF") else None


def _is_deep(document: Document) -> bool:
    """Whether elements are nested so deeply that the recursive functions of minidom would fail."""
    level: list[Node] = [*document.childNodes]
    for _ in range(_MAX_DEPTH):
        level = [child for node in level for child in node.childNodes]
    return bool(level)


def _serialise(document: Document) -> bytes:
    root = "".join(node.toxml() for node in document.childNodes if isinstance(node, Element))
    return _PACKET.format(root).encode(errors="replace")


def _rdf(document: Document) -> Element:
    return document.getElementsByTagNameNS(_RDF, "RDF")[0]


def _name(node: Attr | Element) -> str:
    return f"{node.namespaceURI} {node.localName}"


def _attributes(element: Element) -> list[Attr]:
    return [*element.attributes.values()]


def _merge(document: Document, extension: Document) -> None:
    """Adds the descriptions of an extended packet to the main packet, with the prefixes that they
    use.
    """
    for description in _descriptions(extension):
        copy = document.importNode(description, deep=True)
        parent = description.parentNode
        while parent and parent.attributes:
            for attribute in _attributes(parent):
                if attribute.namespaceURI == _XMLNS and not copy.hasAttribute(attribute.name):
                    copy.setAttributeNS(_XMLNS, attribute.name, attribute.value)
            parent = parent.parentNode
        _rdf(document).appendChild(copy)


def _descriptions(document: Document) -> list[Element]:
    elements = (node for node in _rdf(document).childNodes if isinstance(node, Element))
    return [element for element in elements if element.localName == "Description"]


def _properties(document: Document) -> Iterator[tuple[int, Callable[[], object]]]:
    """Yields the size of each property in bytes, and the function that removes it."""
    for description in _descriptions(document):
        for attribute in _attributes(description):
            if attribute.namespaceURI not in (_XMLNS, _RDF):
                size = len(attribute.name) + len(attribute.value.encode()) + 4
                yield size, partial(description.removeAttributeNode, attribute)
        for child in [*description.childNodes]:
            if isinstance(child, Element):
                yield len(child.toxml().encode()), partial(description.removeChild, child)
