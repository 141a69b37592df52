"""Jobs of users as whole processes: `livepde run` against a fit that the user would write.

`data` makes the tables by a finite-volume code of its own and states the cases; `fits` has the
scripts, each as lean as it could be made; `report` times both and compares their estimates.
"""
