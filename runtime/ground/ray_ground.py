#!/usr/bin/env python3
"""A merge on a Ray cluster: plan here, a task per cell anywhere, join here. Options behind `--` go to `dgtr ground plan`.

    pip install ray
    ray_ground.py --store /shared/field --out merged models/*.dgtr -- --mission mission.toml

Every machine needs `dgtr` and sees the store: a folder they share, or s3://BUCKET/PREFIX (the AWS variables go along).
A task whose machine or worker dies is done again elsewhere; what it had finished is there already. Run it again to go on.
"""

import argparse
import os
import subprocess
import sys

import ray

# What a failed command's exit code says will not get better: bad input, no device.
HOPELESS = (2, 3)


class Hopeless(Exception):
    """Trying again would not help."""


def dgtr(program, *arguments):
    """Runs `dgtr ground …` and gives the lines it printed."""
    done = subprocess.run([program, "ground", *arguments], stdout=subprocess.PIPE, text=True)
    if done.returncode:
        what = f"dgtr ground {' '.join(arguments)} ended with {done.returncode}"
        raise Hopeless(what) if done.returncode in HOPELESS else RuntimeError(what)
    return done.stdout.splitlines()


@ray.remote(max_retries=3, retry_exceptions=[RuntimeError])
def cell(program, key, store, device):
    return dgtr(program, "cell", key, "--store", store, *device)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="+", help="the aircraft's .dgtr models")
    parser.add_argument("--store", required=True, help="folder that all machines share, or s3://BUCKET/PREFIX")
    parser.add_argument("--out", required=True, help="folder for global.dgtr")
    parser.add_argument("--dgtr", default="dgtr", help="the program, where it lies on every machine")
    parser.add_argument("--device", help="Vulkan device of the workers, by part of its name")
    parser.add_argument("--cpus", type=float, default=1, help="processors that a cell takes")
    parser.add_argument("--gpus", type=float, default=0, help="GPUs that a cell takes")
    parser.add_argument("--workers", type=int, help="without a cluster: cells at once on this machine")
    arguments = sys.argv[1:]
    split = arguments.index("--") if "--" in arguments else len(arguments)
    args, plan = parser.parse_args(arguments[:split]), arguments[split + 1 :]

    keys = dgtr(args.dgtr, "plan", *args.models, "--store", args.store, *plan)
    print(f"{len(keys)} cells to make")
    aws = {name: value for name, value in os.environ.items() if name.startswith("AWS_")}
    here = {"num_cpus": args.workers * args.cpus, "include_dashboard": False} if args.workers else {}
    ray.init(runtime_env={"env_vars": aws}, log_to_driver=False, **here)
    device = ["--device", args.device] if args.device else []
    task = cell.options(num_cpus=args.cpus, num_gpus=args.gpus)
    waiting = [task.remote(args.dgtr, key, args.store, device) for key in keys]
    while waiting:
        done, waiting = ray.wait(waiting)
        for line in ray.get(done[0]):
            print(line, flush=True)
    print("\n".join(dgtr(args.dgtr, "join", "--store", args.store, "--out", args.out)))


if __name__ == "__main__":
    try:
        main()
    except (Hopeless, RuntimeError, ray.exceptions.RayError) as e:
        sys.exit(f"ray_ground.py: {e}")
