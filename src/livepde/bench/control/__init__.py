"""Identified models in control loops, against the true model, a wrong one, and a moving horizon."""
