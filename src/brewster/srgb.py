"""The old path of `brewster.photo.srgb`, for one version."""

from brewster.base.old_paths import moved

__getattr__ = moved(__name__, "brewster.photo.srgb")
