"""What the program wrote, held against the published schemas by another program's validator."""

from __future__ import annotations

from functools import cache
from typing import Any

import fastjsonschema

from tactile_bayes.files.documents import load_schema


def check_document(document: object, schema_name: str) -> None:
    """Refuse a document that its schema does not allow."""
    _validator(schema_name)(document)


@cache
def _validator(schema_name: str) -> Any:
    return fastjsonschema.compile(load_schema(schema_name))
