"""Studies that use the truth or hindsight, which the library must never see. Not installed.

Run both in the project folder. `python -m experiments NAME` runs a study and checks its numbers;
`python -m experiments.NAME` runs a script, which prints a table.
"""
