"""The reference renderer, Mitsuba: against it the analytic renderer is compared."""
