import numpy as np

from brewster.cache import ByteLimitedCache


def test_the_values_that_were_not_used_for_the_longest_time_are_dropped():
    cache = ByteLimitedCache(600)
    first, _ = (cache.get_or_create(name, lambda: np.zeros(300, np.uint8)) for name in "ab")
    assert cache.get("a") is first
    third = cache.get_or_create("c", lambda: np.zeros(300, np.uint8))
    assert (cache.get("b"), cache.get("a") is first, cache.get("c") is third) == (None, True, True)
    large = cache.get_or_create("large", lambda: np.zeros(30_000, np.uint8))
    assert (cache.get("c"), cache.get("large") is large) == (None, True)
