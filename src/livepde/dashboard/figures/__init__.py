"""Figures of a run in a browser, for the live page and for reports."""
