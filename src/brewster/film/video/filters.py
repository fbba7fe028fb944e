"""Deinterlaces the frames of a film and cuts off what a player hides."""

from collections.abc import Iterable, Iterator
from typing import Final

import av
import av.filter

from brewster.film.video.container_crop import Crop

_PARITIES: Final = {2: "tff", 3: "bff", 4: "bff", 5: "tff"}
"""Which field is displayed first, by the values of AVFieldOrder of FFmpeg. The filter does not find
it in the frames that PyAV gives to it.
"""


def filtered(
    frames: Iterable[av.VideoFrame], stream: av.VideoStream, crop: Crop | None
) -> Iterator[av.VideoFrame]:
    """Yields the frames without combing and without the hidden border.

    Both fields of an interlaced frame become one frame, which shows the time of the first field
    (bwdif, the Bob Weaver deinterlacing filter of FFmpeg). From the first interlaced frame on,
    those that are not interlaced pass through the filter unchanged.
    """
    graph = None
    kind: tuple[str, bool] | None = None
    is_interlaced = False
    for frame in frames:
        is_interlaced |= frame.interlaced_frame
        if not is_interlaced and crop is None:
            yield frame
            continue
        if kind != (frame.format.name, is_interlaced):
            if graph:
                yield from _pulled(graph, None)
            kind = frame.format.name, is_interlaced
            graph = _graph(frame, stream, crop, is_interlaced=is_interlaced)
        assert graph
        yield from _pulled(graph, frame)
    if graph:
        yield from _pulled(graph, None)


def _graph(
    frame: av.VideoFrame, stream: av.VideoStream, crop: Crop | None, *, is_interlaced: bool
) -> av.filter.Graph:
    graph = av.filter.Graph()
    nodes = [
        graph.add_buffer(
            width=frame.width,
            height=frame.height,
            format=frame.format,
            time_base=frame.time_base or stream.time_base,
        )
    ]
    if is_interlaced:
        parity = _PARITIES.get(stream.codec_context.field_order, "auto")
        nodes.append(graph.add("bwdif", f"mode=send_frame:parity={parity}:deint=interlaced"))
    if crop:
        width = frame.width - crop.left - crop.right
        height = frame.height - crop.top - crop.bottom
        nodes.append(graph.add("crop", f"{width}:{height}:{crop.left}:{crop.top}:exact=1"))
    nodes.append(graph.add("buffersink"))
    graph.link_nodes(*nodes).configure()
    return graph


def _pulled(graph: av.filter.Graph, frame: av.VideoFrame | None) -> Iterator[av.VideoFrame]:
    """Gives a frame to a graph, or its end, and yields the frames that are ready."""
    graph.vpush(frame)
    while True:
        try:
            yield graph.vpull()
        except (av.BlockingIOError, av.EOFError):
            return
