"""A fuzzer of the command `cgwm`: valid inputs, mutations of them, an oracle, and tables of what must be refused.

`python -m fuzz --help` (with tests/ on the path) runs it at length; `tests/test_fuzz.py` runs a selection.
"""
