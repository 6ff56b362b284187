#!/usr/bin/env python3
"""Puts what `pipelines` printed for each board into one Markdown table and compares it with the checked-in one:

    table.py TABLE VERSION BOARD=FILE...      (DGTR_BLESS=1 writes TABLE)

Ends with 1 and names the kernels that spill more than TABLE says, no longer compile, or are not in it."""
import os
import re
import sys

HEAD = """# Kernels by driver

`tests/boards.sh` makes this table (`DGTR_BLESS=1` writes it) and fails when a kernel spills more or no longer compiles. Mesa {}.

Instructions, then: V3D (Pi 5, Pi 4): t threads per core (4 best), spills/fills, bytes of memory per lane for them and for arrays.
Mali (G610): t threads (2: full occupancy, at most 32 registers), spills/fills. Adreno: w waves per core (16 best), stores/loads
of private memory. `name:lanes`; `+half` moments in 16 bits, `+staged` Gaussians fetched by the lanes of a tile for each other,
`+rolled` their sums over a tile in a loop, `+storage` reads storage buffers instead of texels. Without `_runs` and `_group`: one lane
per tile or share. `_short`: a lane holds the sums of two pixels of a strip at once instead of eight.

"""


def read(path):
    """Cells by kernel and board, and the version of Mesa."""
    rows, boards, version = {}, [], "?"
    for line in open(path, encoding="utf-8") if os.path.exists(path) else []:
        version = (re.search(r"Mesa ([\w.~+-]+[\w])", line) or [None, version])[1]
        cells = [c.strip() for c in line.strip().strip("|").split("|")]
        if line.startswith("| kernel"):
            boards = cells[1:]
        elif line.startswith("| "):
            rows[cells[0]] = dict(zip(boards, cells[1:]))
    return rows, boards, version


def lines_of(rows, boards):
    """The table as Markdown."""
    lines = ["| kernel | " + " | ".join(boards) + " |", "|---" * (len(boards) + 1) + "|"]
    return lines + [f"| {k} | " + " | ".join(c.get(b, "") for b in boards) + " |" for k, c in sorted(rows.items())]


def memory(cell):
    """Spills, fills and bytes of a cell."""
    found = re.search(r" (\d+)/(\d+)(?: (\d+) B)?", cell)
    return tuple(int(n or 0) for n in found.groups()) if found else (0, 0, 0)


def main():
    table, version = sys.argv[1:3]
    made, boards = {}, []
    for argument in sys.argv[3:]:
        board, path = argument.split("=", 1)
        boards.append(board)
        for line in open(path, encoding="utf-8"):
            kernel, cell = line.rstrip("\n").split("\t")
            made.setdefault(kernel, {})[board] = cell
    print("\n".join(lines_of(made, boards)))
    known, known_boards, known_version = read(table)
    if os.environ.get("DGTR_BLESS"):
        # The columns of boards that were not asked for stay.
        merged = {kernel: {**known.get(kernel, {}), **cells} for kernel, cells in made.items()}
        order = known_boards + [b for b in boards if b not in known_boards]
        with open(table, "w", encoding="utf-8") as out:
            out.write(HEAD.format(version) + "\n".join(lines_of(merged, order)) + "\n")
        return 0
    worse, better = [], 0
    for kernel, cells in sorted(made.items()):
        for board, cell in cells.items():
            before = known.get(kernel, {}).get(board)
            if not before:
                worse.append(f"{kernel} on {board}: {cell}, not in the table yet")
            elif cell in ("", "fails") and before != cell:
                worse.append(f"{kernel} on {board}: no longer compiles, was {before}")
            elif any(a > b for a, b in zip(memory(cell), memory(before))) and before != "fails":
                worse.append(f"{kernel} on {board}: {cell}, was {before}")
            else:
                better += memory(cell) < memory(before)
    if version != known_version:
        print(f"boards.sh: compiled by Mesa {version}, the table by {known_version}", file=sys.stderr)
    for line in worse:
        print(f"boards.sh: {line}", file=sys.stderr)
    if better:
        print(f"boards.sh: {better} spill less than the table says; DGTR_BLESS=1 writes it", file=sys.stderr)
    return 1 if worse else 0


sys.exit(main())
