"""Jobs of users as whole processes: `livepde run` against a fit that the user would write.

`data` makes the tables with a separate finite-volume code, and has the cases. `fits` has lean
scripts that fit them. `report` times both and compares their estimates.
"""
