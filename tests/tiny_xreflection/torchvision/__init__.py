"""Only what XReflection needs of torchvision, which has no build for the torch of these tests."""

from torchvision import models  # noqa: F401
