from .mcap_file import read_mcap as read_mcap
