"""How long tests wait for what has to come."""

PATIENCE = 600.0  # seconds: more than any machine needs, it only ends what hangs
