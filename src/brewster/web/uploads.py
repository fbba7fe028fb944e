"""The files of one upload: a photo, the photos of a burst, or a film. A client sends them once, and
names them by their key in several requests.
"""

import hashlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import final

from brewster.base.image_formats import is_video, is_video_content


@final
@dataclass(frozen=True)
class Upload:
    """The files of one upload, in memory."""

    names: tuple[str, ...]
    """The names of the files, as returned by `safe_name`."""
    contents: tuple[bytes, ...]
    """The photo, the photos of a burst in the order in which they were taken, or a film."""
    film: bytes | None = None
    """The film that a phone recorded around the photo, if it was sent as a file of its own."""

    @cached_property
    def is_video(self) -> bool:
        """Whether one of the files is a video."""
        named = zip(self.names, self.contents, strict=True)
        return any(is_video(Path(name)) or is_video_content(content) for name, content in named)

    @cached_property
    def digests(self) -> tuple[bytes, ...]:
        """The SHA-256 of each of the `contents`."""
        return tuple(hashlib.sha256(content).digest() for content in self.contents)

    @cached_property
    def film_digest(self) -> bytes | None:
        """The SHA-256 of the film, or None."""
        return None if self.film is None else hashlib.sha256(self.film).digest()

    @cached_property
    def key(self) -> str:
        """64 hexadecimal digits. The same files with the same names have the same key."""
        parts = *(name.encode() for name in self.names), *self.digests, self.film_digest or b""
        joined = hashlib.sha256(bytes([len(self.contents)]))
        for part in parts:
            joined.update(len(part).to_bytes(4, "big") + part)
        return joined.hexdigest()

    @property
    def nbytes(self) -> int:
        """The memory of the files."""
        return sum(map(len, self.contents)) + len(self.film or b"")
