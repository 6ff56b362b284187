#!/usr/bin/env python3
"""Writes tests/data/advisories.txt from a clone of https://github.com/rustsec/advisory-db (CC0): `tests/advisories.py CLONE`.

One line for each advisory that stands: its id, the crate, the versions that are mended or were never affected."""
import pathlib, re, subprocess, sys, tomllib

clone, here = sys.argv[1], pathlib.Path(__file__).parent
git = lambda *a: subprocess.run(["git", "-C", clone, *a], capture_output=True, text=True, check=True).stdout
lines = []
for name in git("ls-tree", "-r", "HEAD", "--name-only", "crates").splitlines():
    if not (found := re.match(r"crates/([^/]+)/(RUSTSEC-[0-9-]+)\.md$", name)):
        continue
    text = tomllib.loads(re.search(r"```toml\n(.*?)```", git("show", f"HEAD:{name}"), re.S)[1])
    if "withdrawn" not in text["advisory"]:
        versions = text.get("versions", {})
        good = versions.get("patched", []) + versions.get("unaffected", [])
        lines.append(" ".join([found[2], found[1], "|".join(v.replace(" ", "") for v in good)]).strip())
head = git("log", "-1", "--format=# RustSec advisories of %cs, commit %H: id, crate, versions that are not affected; tests/advisories.py writes it.")
(here / "data/advisories.txt").write_text(head + "\n".join(sorted(lines, key=lambda l: l.split()[1::-1])) + "\n")
