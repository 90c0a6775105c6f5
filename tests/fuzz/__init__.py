"""Hostile inputs for everything that reads from outside: files, projects, pictures, receipts, the studio's messages.

    python -m tests.fuzz --seconds 600 --targets ply,spz --seed 0 --jobs 2 --out out/fuzz      (`make fuzz`)
    python -m tests.fuzz --targets ply --replay 1234                                          (one input again)

An input is a pure function of its target and its seed number. Each target (target.py) knows the structure of what it
bends: headers, counts, JSON trees, zip directories, packed payloads, database cells; so inputs get past first checks.
worker.py runs inputs in a process of its own under limits; supervisor.py starts workers and notices when one dies.
"""
