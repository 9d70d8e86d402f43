"""The command `drake-diff`, with one module for each group of commands."""
