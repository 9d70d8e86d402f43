"""The same model in other simulators: each engine in a file of its own, imported when it is asked for."""
