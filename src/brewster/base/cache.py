"""A cache with a limit in bytes."""

from collections import OrderedDict
from collections.abc import Callable, Hashable
from operator import attrgetter
from threading import Lock
from typing import Generic, TypeVar, final

_Value = TypeVar("_Value")


@final
class ByteLimitedCache(Generic[_Value]):
    """Values by key. Thread-safe. If they together exceed `max_bytes`, the least recently used ones
    are dropped.
    """

    def __init__(
        self, max_bytes: int, count_bytes: Callable[[_Value], int] = attrgetter("nbytes")
    ) -> None:
        self._values = OrderedDict[Hashable, _Value]()
        self._bytes = 0
        self._lock = Lock()
        self._max_bytes = max_bytes
        self._count_bytes = count_bytes

    def get(self, key: Hashable) -> _Value | None:
        """Returns the value of this key, or None if there is none, for example because it was
        dropped.
        """
        with self._lock:
            if key in self._values:
                self._values.move_to_end(key)
            return self._values.get(key)

    def get_or_create(self, key: Hashable, create: Callable[[], _Value]) -> _Value:
        """Returns the value of this key. A new value is stored, even if it alone exceeds
        `max_bytes`.
        """
        value = self.get(key)
        if value is None:
            value = create()
            with self._lock:
                if key not in self._values:  # another thread may have inserted it
                    self._values[key] = value
                    self._bytes += self._count_bytes(value)
                while self._bytes > self._max_bytes and len(self._values) > 1:
                    self._bytes -= self._count_bytes(self._values.popitem(last=False)[1])
        return value
