"""Limits of time that count processor time, in what `acceptance.py` runs: load on the machine decides nothing.

`drake_diff` reads limits from `time.monotonic`; the standard library's modules keep the clock that they have here.
"""

import concurrent.futures
import multiprocessing.connection
import queue
import selectors
import subprocess
import threading
import time

LOADED = (concurrent.futures, multiprocessing.connection, queue, selectors, subprocess, threading)
time.monotonic = time.process_time
