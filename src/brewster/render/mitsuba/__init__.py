"""The reference renderer: path tracing by Mitsuba 3, which validates the analytic renderer."""
