"""Jobs of users as whole processes: `livepde run` compared with a fit that a user would write.

`data` defines the cases, and simulates their tables with a separate finite-volume code. `fits`
contains lean scripts that fit them. `report` times both, and compares their estimates.
"""
