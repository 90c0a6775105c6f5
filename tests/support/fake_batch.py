"""A stand-in for `splatpainter batch --events`: makes one result for each letter of its second argument, then does what
the third says: "end", "hang" (until its stdin ends), "crash". Run in the folder of a batch."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path


def main(results: str, then: str) -> None:
    jobs = json.loads(Path("batch.yaml").read_text(encoding="utf-8"))
    names = [Path(asset).stem for asset in jobs["assets"]]
    if jobs["variants"]:
        names = [f"{names[0]}-{variant['name']}" for variant in jobs["variants"]]

    def say(**event: object) -> None:
        print(json.dumps(event), flush=True)

    print("a line that is no event")
    for number, (name, letter) in enumerate(zip(names, results, strict=False)):
        say(event="started", job=number)
        record = {"status": "failed", "error": f"assets/{name}.ply: expected something else"}
        if letter == "d":
            folder = Path("out") / "jobs" / name
            folder.mkdir(parents=True)
            for file in (f"out/{name}.ply", f"out/{name}.ply.receipt.json"):
                Path(file).write_text(file, encoding="utf-8")
            for picture in ("before.webp", "after.webp"):
                (folder / picture).write_bytes(b"RIFF")
            record = {"status": "done", "rows": 600, "touched": 41, "appended": 7}
        say(event="ended", job=number, record=record)
    if len(results) < len(names):
        say(event="started", job=len(results))
    if then == "crash":
        sys.exit("no memory left")
    if then == "hang":
        while os.read(0, 100):
            pass
    Path("out").mkdir(exist_ok=True)
    Path("out/index.html").write_text("<title>batch</title>", encoding="utf-8")
    say(event="end")


if __name__ == "__main__":
    main(*sys.argv[1:])
