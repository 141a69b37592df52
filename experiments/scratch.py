"""Least-squares fits of scratch assays, for several choices of initial state, weights and equation.

Each fit uses livepde's forward model (`batch.py`) and all samples, without a prior. "as measured"
starts from the first sample; "weighted" also uses the published weights u^-0.2, which reduce the
residuals, without the outlier on the left; "fitted, too" estimates the initial density.
"""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np

from experiments.batch import Forward, fit


def main() -> None:
    print(f"{'cells':8}{'equation, start':28}{'D [mm^2/d]':>10}{'r [1/d]':>9}{'left [1/mm^2]':>15}")
    places, guess = np.linspace(0.025, 1.875, 38), [0.01, 1.0]
    for density, equation in product((10, 14, 18), ("fisher_kpp", "porous_fisher")):
        settings = {"data.options.density": density, "equation": equation}
        forward = Forward("scratch_assay", settings)
        z = forward.z

        def known(p: Any, u0: Any = None, forward: Forward = forward) -> Any:
            return forward({"D": p[0], "r": p[1]}, u0)

        def weighted(p: Any, z: Any = z) -> Any:  # without the outlier on the left
            predicted = known(p)[1:, 1:]
            return (z[1:, 1:] - predicted) / np.abs(predicted) ** 0.2

        def free(p: Any, z: Any = z) -> Any:
            return z - known(p, lambda x: np.interp(x[0], places, p[2:]))

        def plain(p: Any, z: Any = z) -> Any:
            return (z - known(p))[1:]

        fits = {"as measured": fit(plain, guess)}
        if equation == "fisher_kpp":
            fits["weighted"] = fit(weighted, guess)
            fits["fitted, too"] = fit(free, [*guess, *np.maximum(z[0], 1.0)])
        for title, (p, left) in fits.items():
            print(f"{density} 000  {equation + ', ' + title:34}{p[0]:8.4f}{p[1]:9.2f}{left:15.1f}")


if __name__ == "__main__":
    main()
