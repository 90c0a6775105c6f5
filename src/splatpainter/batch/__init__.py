"""What a batch is: the format of a JOBS.yaml (schema.py) and the numbered jobs that it asks for (plan.py). The work
itself is `splatpainter batch` (commands/batch/), which the studio runs as a program of its own."""
