"""The contract (`base.py`), and one file per mechanism family."""
