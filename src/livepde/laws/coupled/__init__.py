"""The coupled implicit stage of the gradient law: data, equation, solvers."""
