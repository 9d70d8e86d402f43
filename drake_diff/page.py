"""What a page of HTML may do in a browser: run the scripts that it was written with, and nothing from the network."""

import base64
import re
from hashlib import sha256

_SCRIPT = re.compile(r"<script(?![^>]*application/json)[^>]*>(.*?)</script>", re.DOTALL)


def content_policy(*pages: str) -> str:
    """The meta element that lets exactly the scripts in `pages` run, by their hashes, and lets nothing be fetched."""
    scripts = dict.fromkeys(script for page in pages for script in _SCRIPT.findall(page) if script)
    hashes = [base64.b64encode(sha256(script.encode()).digest()).decode() for script in scripts]
    policy = "; ".join(
        [
            "default-src 'none'",
            "script-src " + " ".join(f"'sha256-{found}'" for found in hashes),
            "style-src 'unsafe-inline'",
            "img-src data: blob:",
            "connect-src data:",  # the viewer fetches its own data out of the page
            "base-uri 'none'",
            "form-action 'none'",
        ]
    )
    return f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
