"""Studies beside the package: what needs the truth or hindsight, which the library must never see.

`python -m experiments NAME`, in the folder of the project, runs a study, whose numbers are checked;
`python -m experiments.NAME` a script, which prints a table. Nothing here is installed.
"""
