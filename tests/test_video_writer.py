"""What a new video keeps of the film: its sound, its languages, its date, make and title."""

from fractions import Fraction

import av
import cv2
import numpy as np
import pytest

from brewster.film import separate_video
from brewster.film.video.decoding import decoded
from brewster.film.video.sound import SoundTracks
from brewster.film.video.writer import VideoWriter
from simulated_bursts import PICTURES
from video_files import film_of


@pytest.fixture(scope="module")
def frames():
    picture = cv2.imread(str(PICTURES[0]))
    return film_of(cv2.resize(picture, (480, 360), interpolation=cv2.INTER_AREA), 30, (64, 48))


def rewritten(source, target):
    """Writes the frames of a film as they are. Returns what is left out."""
    frames = list(decoded(source, 10**8, is_complete=True))
    sound = SoundTracks.that_fit(source, target.suffix)
    ends = [*(frame.time_s for frame in frames[1:]), 2 * frames[-1].time_s - frames[-2].time_s]
    with VideoWriter(
        target, sound, stream=frames[0].stream, start_s=frames[0].time_s, size=frames[0].size
    ) as writer:
        for frame, end_s in zip(frames, ends, strict=True):
            writer.write(frame.picture(), frame.time_s, end_s - frame.time_s)
    return sound.note


def write_sounds(
    path, frames, sounds, *, default=0, metadata=(), seconds=1.0, start_s=0.0, film_start_s=0
):
    """Writes a film with sounds: pairs of a codec and a language. The sounds begin `start_s` after
    the film.
    """
    with av.open(str(path), "w", container_options={"movflags": "+use_metadata_tags"}) as container:
        container.metadata.update(metadata)
        video = container.add_stream("mpeg4", rate=30)
        video.height, video.width = frames[0].shape[:2]
        video.pix_fmt = "yuv420p"
        tracks = []
        for index, (codec, language) in enumerate(sounds):
            track = container.add_stream(codec, rate=48000, layout="mono")
            track.metadata["language"] = language
            track.disposition = av.stream.Disposition.default if index == default else 0
            tracks.append(track)
        for number, frame in enumerate(frames):
            picture = av.VideoFrame.from_ndarray(frame, format="rgb24")
            picture.pts = number + 30 * film_start_s
            picture.time_base = Fraction(1, 30)
            container.mux(video.encode(picture))
        container.mux(video.encode())
        for pitch, track in enumerate(tracks, start=5):
            samples = np.sin(np.arange(round(48000 * seconds)) / pitch)
            block = av.AudioFrame.from_ndarray(
                (20000 * samples).astype(np.int16)[None], format="s16", layout="mono"
            )
            block.sample_rate = 48000
            block.pts = round(48000 * (start_s + film_start_s))
            block.time_base = Fraction(1, 48000)
            packets = [*track.encode(block), *track.encode()]
            container.mux([packet for packet in packets if packet.size])  # FLAC ends with none
    return path


def sounds_of(path):
    """The codec, the language, whether it is the default one, and the length of each sound."""
    with av.open(str(path)) as container:
        found = []
        for track in container.streams.audio:
            container.seek(0)
            packets = [packet for packet in container.demux(track) if packet.size]
            begin = float(packets[0].pts * packets[0].time_base)
            end = float((packets[-1].pts + packets[-1].duration) * packets[-1].time_base)
            is_default = bool(track.disposition & av.stream.Disposition.default)
            found.append((track.codec_context.name, track.language, is_default, begin, end))
        return found


@pytest.mark.parametrize("suffix", [".mp4", ".m4v", ".mov", ".mkv"])
def test_all_sounds_are_kept_with_their_languages(data, tmp_path, suffix):
    target = tmp_path / f"a{suffix}"
    assert rewritten(data / "field/film-two-sounds.mp4", target) is None
    found = sounds_of(target)
    # Two codes of ISO 639-2 for German
    german = "ger" if suffix == ".mov" else "deu"
    assert [sound[:3] for sound in found] == [("aac", german, False), ("aac", "eng", True)]
    for _, _, _, begin, end in found:
        assert begin == pytest.approx(0, abs=0.05)
        assert 1.9 < end < 2.1


@pytest.mark.parametrize(("refused", "source_suffix", "suffix"), [
    ("pcm_u8", ".mkv", ".mp4"), ("libopus", ".mkv", ".mov"), ("flac", ".mp4", ".mov"),
])  # fmt: skip
def test_a_sound_that_a_container_refuses_is_left_out_and_another_is_kept(
    tmp_path, frames, refused, source_suffix, suffix
):
    sounds = [(refused, "deu"), ("aac", "eng")]
    source = write_sounds(tmp_path / f"a{source_suffix}", frames, sounds)
    target = tmp_path / f"b{suffix}"
    note = rewritten(source, target)
    assert refused.removeprefix("lib") in note
    assert [sound[:2] for sound in sounds_of(target)] == [("aac", "eng")]


@pytest.mark.parametrize("film_start_s", [0, 5])
@pytest.mark.parametrize("start_s", [0.0, 0.3])
@pytest.mark.parametrize("suffix", [".mp4", ".mov", ".mkv"])
def test_sound_that_starts_late_stays_late(tmp_path, frames, suffix, start_s, film_start_s):
    """Also in a film that itself starts late, as the part of a longer one."""
    source = write_sounds(
        tmp_path / "a.mkv",
        frames,
        [("aac", "eng")],
        seconds=0.6,
        start_s=start_s,
        film_start_s=film_start_s,
    )
    target = tmp_path / f"b{suffix}"
    rewritten(source, target)
    ((_, _, _, before, _),) = sounds_of(source)
    ((_, _, _, begin, end),) = sounds_of(target)
    assert before == pytest.approx(film_start_s + start_s, abs=0.03)
    assert begin == pytest.approx(start_s, abs=0.03)
    assert end == pytest.approx(start_s + 0.6, abs=0.05)


def test_sound_that_was_cut_away_is_not_copied(tmp_path, frames):
    whole = write_sounds(tmp_path / "a.mp4", frames, [("aac", "eng")])
    trimmed = tmp_path / "trimmed.mp4"
    # Packets before 0 are hidden by an edit list
    with (
        av.open(str(whole)) as source,
        av.open(str(trimmed), "w", options={"avoid_negative_ts": "disabled"}) as target,
    ):
        streams = {stream: target.add_stream_from_template(stream) for stream in source.streams}
        for packet in source.demux():
            if packet.size:
                shift = round(Fraction(2, 5) / packet.time_base)
                packet.pts -= shift
                packet.dts -= shift
                packet.stream = streams[packet.stream]
                target.mux(packet)
    count = len(list(decoded(trimmed, 10**8)))
    assert count == 18
    for suffix in (".mkv", ".mp4"):
        rewritten(trimmed, tmp_path / f"b{suffix}")
        [(_, _, _, begin, end)] = sounds_of(tmp_path / f"b{suffix}")
        assert -0.05 < begin < 0.05
        assert 0.5 < end < 0.65
    frame_times = [frame.time_s for frame in decoded(tmp_path / "b.mkv", 10**8)]
    assert (len(frame_times), frame_times[0]) == (count, pytest.approx(0, abs=0.03))


METADATA = {
    "creation_time": "2024-05-06T07:08:09.000000Z",
    "title": "Window",
    "com.apple.quicktime.make": "Maker",
    "com.apple.quicktime.model": "Phone",
    "location": "+47.1000+008.5000/",
}


@pytest.mark.parametrize("suffix", [".mp4", ".mov", ".mkv"])
def test_date_make_and_title_of_the_film_are_kept(data, tmp_path, suffix):
    target = tmp_path / f"a{suffix}"
    rewritten(data / "field/film-with-date-make-title.mp4", target)
    with av.open(str(target)) as container:
        found = {key.lower(): text for key, text in container.metadata.items()}
    assert {key: found.get(key) for key in METADATA} == METADATA


@pytest.mark.parametrize("suffix", [".mp4", ".mov", ".mkv"])
def test_a_plain_title_and_date_are_kept(tmp_path, frames, suffix):
    plain = {key: METADATA[key] for key in ("creation_time", "title")}
    source = write_sounds(tmp_path / "a.mkv", frames, [], metadata=plain)
    rewritten(source, tmp_path / f"b{suffix}")
    with av.open(str(tmp_path / f"b{suffix}")) as container:
        found = {key.lower(): text for key, text in container.metadata.items()}
    assert {key: found.get(key) for key in plain} == plain


def test_sound_that_is_longer_than_the_film_ends_with_it_and_gets_no_note(
    data, tmp_path, few_steps
):
    source = data / "field/film-sound-longer.mkv"
    result = separate_video(source, tmp_path / "t.mp4", method="motion")
    assert result.note is None
    [(codec, _, _, _, end)] = sounds_of(tmp_path / "t.mp4")
    assert codec == "opus"
    assert 1.99 < end < 2.03  # 30 frames of 1/15 s, also the last one, and packets of 20 ms


def test_a_film_whose_sound_no_container_takes_is_written_without_it(data, tmp_path, few_steps):
    source = data / "field/film-truehd-sound-to-mp4.mkv"
    result = separate_video(source, tmp_path / "t.mp4", tmp_path / "r.mkv", method="motion")
    assert result.note == "the sound (truehd) was left out, because .mp4 cannot contain it"
    assert sounds_of(tmp_path / "t.mp4") == []
    assert [sound[0] for sound in sounds_of(tmp_path / "r.mkv")] == ["truehd"]


def test_sound_of_a_transport_stream_is_kept(data, tmp_path):
    for suffix in (".mp4", ".mkv"):
        target = tmp_path / f"a{suffix}"
        assert rewritten(data / "field/film-mpegts.ts", target) is None
        with av.open(str(target)) as container:
            heard = sum(frame.samples for frame in container.decode(audio=0))
            assert heard / container.streams.audio[0].rate > 1.8
