"""The command `drake-diff`: one module for each group of commands."""
