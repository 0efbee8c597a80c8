"""Keep survey results: bundles and lifts as JSON in the result, the height map as a file."""

from __future__ import annotations

import datetime
import json
import re
from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from barsight.core.errors import InputError
from barsight.core.reading.bounded_reading import read_json
from barsight.plant.opcua.security.binding import ua

RESULT_FILES = ("bundles.json", "lifts.json")
TRANSFERRED = "height.tif"
MAX_CONTENT_BYTES = 4 << 20
"""Maximum size of a result's JSON in bytes; a larger one is available by file transfer only."""
_ID = re.compile(r"[\w.:+-]{1,80}")


@dataclass(frozen=True)
class SurveyResult:
    """A finished survey. folder: its result folder. job: the job that it was made for."""

    survey: str
    job: str
    recipe: str
    configuration: str
    folder: Path
    is_simulated: bool
    created_at: datetime.datetime
    content: tuple[str, ...]

    @property
    def has_file(self) -> bool:
        """Return True if the result has a file to transfer."""
        return (self.folder / TRANSFERRED).is_file()


def read_result(folder: Path, survey: str, job: str, recipe: str, configuration: str) -> SurveyResult:
    """Read a result folder. Raises InputError if its files can't be read."""
    if not _ID.fullmatch(survey):
        raise InputError(folder, f"{survey[:80]!r} is not the id of a survey", "measure it anew")
    documents = [read_json(folder / name) for name in RESULT_FILES]
    content = tuple(json.dumps(one, separators=(",", ":")) for one in documents)
    simulated = [one.get("is_simulated") for one in documents if isinstance(one, dict)]
    return SurveyResult(
        survey, job, recipe, configuration, folder, any(simulated), datetime.datetime.now(datetime.UTC),
        content if sum(map(len, content)) <= MAX_CONTENT_BYTES else (),
    )  # fmt: skip


class KeptResults:
    """The latest results, by id; adding one drops the oldest if there are too many."""

    def __init__(self, max_results: int) -> None:
        self._max_results = max_results
        self._kept: OrderedDict[str, SurveyResult] = OrderedDict()

    def add(self, result: SurveyResult) -> None:
        """Keep a result."""
        self._kept[result.survey] = result
        while len(self._kept) > self._max_results:
            self._kept.popitem(last=False)

    def get(self, survey: str) -> SurveyResult | None:
        """Return a result by its id."""
        return self._kept.get(survey)

    def list_newest(self) -> list[SurveyResult]:
        """List results, the newest first."""
        return list(reversed(self._kept.values()))


def told(result: SurveyResult) -> Any:
    """Convert a result to the specification's ResultDataType."""
    structure = ua.ResultDataType()
    structure.ResultId = ua.ResultIdDataType(Id=result.survey)
    structure.HasTransferableDataOnFile = result.has_file
    structure.IsPartial = False
    structure.IsSimulated = result.is_simulated
    structure.ResultState = ua.ResultStateDataType(1)
    structure.InternalRecipeId = ua.RecipeIdInternalDataType(Id=result.recipe)
    structure.InternalConfigurationId = ua.ConfigurationIdDataType(Id=result.configuration)
    structure.JobId = ua.JobIdDataType(Id=result.job)
    structure.CreationTime = result.created_at
    structure.ResultContent = [ua.Variant(one, ua.VariantType.String) for one in result.content]
    return structure
