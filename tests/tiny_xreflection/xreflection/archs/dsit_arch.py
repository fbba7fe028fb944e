from xreflection.archs.swin_det import window_reverse  # noqa: F401
