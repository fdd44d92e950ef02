# SPDX-License-Identifier: Apache-2.0
"""One SUMO simulation in a process of its own: libsumo holds a single simulation a process.

Run as a script with the path of a JSON job; imports nothing of manyeyes, so that it starts fast. Writes an .npz with
step, vehicle (both int64), and state (float64: x, y, z of the front bumper, SUMO's angle in degrees, speed), a row each.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path


def main(job_path: str) -> None:
    """Run the job: warm up, then record every step."""
    import numpy as np

    try:
        import libsumo
    except ImportError:
        sys.exit("libsumo is not installed")
    job = json.loads(Path(job_path).read_text())
    libsumo.start(["sumo", *job["arguments"]])
    step, vehicle, state = [], [], []
    for _ in range(job["warmup_steps"]):
        libsumo.simulationStep()
    for k in range(job["steps"]):
        libsumo.simulationStep()
        for name in libsumo.vehicle.getIDList():
            step.append(k)
            vehicle.append(int(name))
            state.append(
                (
                    *libsumo.vehicle.getPosition3D(name),
                    libsumo.vehicle.getAngle(name),
                    libsumo.vehicle.getSpeed(name),
                )
            )
    libsumo.close()
    rows = np.array(state, np.float64).reshape(-1, 5)
    np.savez(job["output"], step=np.array(step, np.int64), vehicle=np.array(vehicle, np.int64), state=rows)


if __name__ == "__main__":
    # A script's own folder comes first on the path, where sibling modules could hide those of other packages.
    sys.path.pop(0)
    main(sys.argv[1])
