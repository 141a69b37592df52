"""The paper's theory as computable quantities: only the command line and tests use it."""
