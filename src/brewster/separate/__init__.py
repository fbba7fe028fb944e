"""How do I use it? `Separator` and `separate`; a photograph here wakes no renderer and no trainer.

`brewster.separate` names this room and the function in it, so the room can be called:
`brewster.separate("window.jpg")` is `brewster.separate.separate("window.jpg")`.
"""

import inspect
import sys
from types import ModuleType

from brewster.options import Quality
from brewster.separate.look import QUALITIES
from brewster.separate.separator import Separation, Separator, separate

__all__ = ["QUALITIES", "Quality", "Separation", "Separator", "separate"]


class _Room(ModuleType):
    __call__ = staticmethod(separate)
    __signature__ = inspect.signature(separate)  # or tools would take `source` for a `self`, and hide it


sys.modules[__name__].__class__ = _Room
