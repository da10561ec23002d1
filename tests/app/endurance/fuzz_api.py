"""Walk the whole HTTP interface by its own description with made-up values; no answer may be a 500.

    python tests/app/endurance/fuzz_api.py [--minutes 10] [--seed 0]

Starts a service on an empty folder, gives it one calibrated photo, and lets schemathesis ask for everything
that `/openapi.json` describes, and for what it forbids; `fuzz_hooks.py` lets most requests be about what is
there. All but the erasure of the account, after which nothing would be. Needs the extra `dev`.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import programs
from running import LIGHT, Service, running, write_photo

HERE = Path(__file__).resolve().parent
SPARE = 12
"""Photos that requests may delete (chosen: some for each of the phases)."""


def things(service: Service, folder: Path) -> tuple[dict[str, list[str]], list[str]]:
    """Put one of each into a service; return their ids by parameter, and photos that may go."""
    photo = service.calibrated(write_photo(folder / "one.dng", 1))
    wish = {"photo_id": photo["id"], "method": "fast", "output": {"format": "png8"}}
    correction = service.http.post("/v1/corrections", json=wish).json()
    service.job(correction["id"])
    spare = [
        service.upload(write_photo(folder / f"{number}.dng", number), calibrate="false")["id"]
        for number in range(2, 2 + SPARE)
    ]
    ids = {
        "photo_id": [photo["id"]],
        "lens_id": [photo["lens_id"]],
        "correction_id": [correction["id"]],
        "job_id": [photo["id"], correction["id"]],
    }
    return ids, spare


def main() -> int:
    """Run for the time that was asked for; return the status of schemathesis."""
    wishes = programs.wishes(__doc__, minutes=10.0, seed=0)
    with tempfile.TemporaryDirectory() as folder, running(Path(folder) / "data", LIGHT) as service:
        ids, spare = things(service, Path(folder))
        profile = Path(folder) / "known.lensprofile"
        answer = service.http.get(f"/v1/lenses/{ids['lens_id'][0]}/profile")
        profile.write_bytes(answer.raise_for_status().content)
        program = Path(sys.executable).with_name("schemathesis")
        command = [
            *(str(program), "run", f"{service.info()['url']}/openapi.json"),
            *("--checks", "not_a_server_error", "--phases", "examples,coverage,fuzzing"),
            *("--max-time", str(int(60 * wishes.minutes)), "--seed", str(wishes.seed)),
            *("--exclude-path-regex", "/events$", "--request-timeout", "60", "--continue-on-failure"),
            *("--exclude-operation-id", "eraseAccount"),
        ]
        environment = {k: v for k, v in os.environ.items() if not k.startswith("LENS_")} | {
            "SCHEMATHESIS_HOOKS": str(HERE / "fuzz_hooks.py"),
            "LENSMODEL_FUZZ_IDS": json.dumps(ids),
            "LENSMODEL_FUZZ_SPARE": json.dumps(spare),
            "LENSMODEL_FUZZ_PROFILE": str(profile),
        }
        status = subprocess.run(command, env=environment, cwd=folder, check=False).returncode
        # a record begins with its time; the traceback of an error follows on lines of its own
        records = re.split(r"\n(?=\d{4}-\d\d-\d\d )", service.log.read_text())
        lost = [record for record in records if " ERROR " in record]
        print("\n".join(lost[:20]))
        print(f"schemathesis ended with {status}; {len(lost)} errors in the service's log")
    return status


if __name__ == "__main__":
    sys.exit(main())
