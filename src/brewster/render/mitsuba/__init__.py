"""The reference renderer: path tracing by Mitsuba 3, to validate the analytic renderer."""
