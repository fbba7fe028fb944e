"""Films and sound for tests."""

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
    path, frames, *, codec="mpeg4", rate=30, times=None, pixel_format="yuv420p", aspect=None
):
    """Writes frames. `times` are in units of 1 / rate."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=rate)
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
            picture.height, picture.width, picture.pix_fmt = *cover.shape[:2], "rgb24"
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
