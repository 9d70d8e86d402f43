"""Many trials from one declarative file: every combination evaluated once, in one table."""
