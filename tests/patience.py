"""Time limit of tests that wait for an event."""

PATIENCE = 600.0  # seconds, more than any machine needs; it only ends tests that hang
