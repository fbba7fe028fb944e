"""Films and sound for tests."""

import struct
from fractions import Fraction

import av
import numpy as np


def film_of(picture, count, size=(240, 180), step=2):
    """The frames of a camera that moves to the right."""
    return [
        np.ascontiguousarray(picture[60 : 60 + size[1], step * i : step * i + size[0]])
        for i in range(count)
    ]


def write_video(
    path,
    frames,
    *,
    codec="mpeg4",
    rate=30,
    times=None,
    pixel_format="yuv420p",
    aspect=None,
    options=None,
    container_options=None,
):
    """Writes frames. `times` are in units of 1 / rate."""
    with av.open(str(path), "w", options=container_options) as container:
        stream = container.add_stream(codec, rate=rate, options=options)
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = pixel_format
        stream.bit_rate = 4_000_000
        if aspect:
            stream.codec_context.sample_aspect_ratio = aspect
        for number, frame in enumerate(frames):
            picture = av.VideoFrame.from_ndarray(frame, format="rgb24")
            picture.pts = times[number] if times else number
            picture.time_base = Fraction(1, rate)
            container.mux(stream.encode(picture))
        container.mux(stream.encode())
    return path


def write_audio(path, cover=None):
    """Writes a second of silence, with a cover picture if it is not None."""
    with av.open(str(path), "w") as container:
        codec = "flac" if path.suffix == ".flac" else "pcm_s16le"
        sound = container.add_stream(codec, rate=8000, layout="mono")
        picture = None
        if cover is not None:
            picture = container.add_stream("png", rate=1)
            picture.height, picture.width = cover.shape[:2]
            picture.pix_fmt = "rgb24"
            picture.disposition = av.stream.Disposition.attached_pic
        samples = av.AudioFrame.from_ndarray(
            np.zeros((1, 8000), np.int16), format="s16", layout="mono"
        )
        samples.sample_rate = 8000
        if picture:
            container.mux(picture.encode(av.VideoFrame.from_ndarray(cover, format="rgb24")))
            container.mux(picture.encode())
        container.mux(sound.encode(samples))
        container.mux(sound.encode())


def copy_packets(source, target, change=lambda _index, content: content):
    """Copies the first video stream of a file to another container, and changes its packets."""
    with av.open(str(source)) as container, av.open(str(target), "w") as copy:
        stream = container.streams.video[0]
        new = copy.add_stream_from_template(stream)
        packets = [packet for packet in container.demux(stream) if packet.size]
        for index, packet in enumerate(packets):
            changed = av.Packet(change(index, bytes(packet)))
            changed.pts = packet.pts
            changed.dts = packet.dts
            changed.time_base = packet.time_base
            changed.is_keyframe = packet.is_keyframe
            changed.stream = new
            copy.mux(changed)
    return target


def turn_display_matrix(path, rotation):
    """Replaces the display matrix in the track header of an mp4."""
    cosine, sine = ((1, 0), (0, 1), (-1, 0), (0, -1))[rotation]
    one = 1 << 16
    unit = struct.pack(">9i", one, 0, 0, 0, one, 0, 0, 0, 1 << 30)
    turned = struct.pack(
        ">9i", cosine * one, sine * one, 0, -sine * one, cosine * one, 0, 0, 0, 1 << 30
    )
    content = path.read_bytes()
    header = content.index(b"tkhd")
    assert content[header:].find(unit) < 100
    path.write_bytes(content[:header] + content[header:].replace(unit, turned, 1))


def clean_aperture_box(size, crop):
    """A box `clap` (ISO/IEC 14496-12, 12.1.4), whose offsets are those of the centre."""
    left, top, right, bottom = crop
    width, height = size
    return struct.pack(">I4s8i", 40, b"clap", width, 1, height, 1, left - right, 2, top - bottom, 2)


def with_clean_aperture(path, box):
    """Inserts a box at the end of the only visual sample entry of an mp4."""
    content = path.read_bytes()
    begin = content.index(b"stsd") + 12
    end = begin + int.from_bytes(content[begin : begin + 4], "big")
    content = content[:end] + box + content[end:]
    places = [
        content.rindex(kind, 0, begin) - 4
        for kind in (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stsd")
    ]
    changed = bytearray(content)
    for place in (*places, begin):
        length = int.from_bytes(changed[place : place + 4], "big") + len(box)
        changed[place : place + 4] = length.to_bytes(4, "big")
    path.write_bytes(bytes(changed))
