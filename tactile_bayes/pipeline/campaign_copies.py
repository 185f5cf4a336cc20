"""Copies of a campaign's files in an object store: a step for each exam and mass, after those that make its files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from tactile_bayes.errors import UsageError
from tactile_bayes.pipeline.campaign_keys import digest_of
from tactile_bayes.pipeline.campaign_staging import Writes
from tactile_bayes.pipeline.campaign_steps import UNWRITTEN, Result, Task


def copy_tasks(folder: Path, names: Sequence[str], results: Sequence[Mapping[str, Result]], *, to: str) -> list[Task]:
    """Tasks that copy what steps made of exams or of masses, keyed by the files' digests and by where they go.

    Parameters
    ----------
    folder
        Holds a folder for each of the names.
    results
        Of each step, by name.
    to
        Address that gets a folder for each of the names.
    """
    tasks = []
    for name in names:
        made = [found[name]["files"] for found in results if name in found]
        files = {file: digest for one in made for file, digest in one.items()}
        if files:
            copies = {file: f"{to}/{name}/{file}" for file in files}
            digest = digest_of({"to": f"{to}/{name}", "files": files})
            tasks.append(Task("copy", name, folder / name, digest, copies=copies))
    return tasks


def copy_step(task: Task) -> tuple[Result, Writes]:
    """Copy files into an object store."""
    from tactile_bayes.files.remote import put

    try:
        for name, address in task.copies.items():
            put(task.folder / name, address)
    except UsageError as error:
        return {UNWRITTEN: str(error)}, {}
    return {}, {}
