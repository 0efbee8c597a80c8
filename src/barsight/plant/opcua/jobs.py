"""Answer the methods of jobs and results: a job waits for the next survey and returns its result."""

from __future__ import annotations

from typing import Any

from barsight.core.errors import InputError
from barsight.plant.opcua.files import Transfers
from barsight.plant.opcua.recipes import NOT_FOUND, RecipeMethods, handle
from barsight.plant.opcua.results import KeptResults, SurveyResult, read_result, told
from barsight.plant.opcua.security.binding import ua
from barsight.plant.opcua.surveys import Survey
from barsight.plant.opcua.vision import VisionSystem, int32, refusal


class JobMethods:
    """Start and stop jobs, and return results.

    Barsight measures what the crane passes over, so a single job is the next survey that ends, and a
    continuous job is every survey until Stop or Abort.
    """

    def __init__(self, vision: VisionSystem, recipes: RecipeMethods, kept_results: int) -> None:
        self._vision = vision
        self._recipes = recipes
        self._results = KeptResults(kept_results)
        self._transfers = Transfers(vision.server, vision.system, vision.index, self._results)
        self._jobs = 0
        self.job = ""

    async def add(self) -> None:
        """Link the methods."""
        machine = ("VisionStateMachine", "AutomaticModeStateMachine")
        for name in ("StartSingleJob", "StartContinuous"):
            await self._vision.answer((*machine, name), "operator", self._starter(name))
        for name in ("Stop", "Abort"):
            await self._vision.answer((*machine, name), "operator", self._stopper(name))
        for name, handler in (
            ("GetResultById", self._get), ("GetResultComponentsById", self._get_components),
            ("GetResultListFiltered", self._list), ("ReleaseResultHandle", _release),
        ):  # fmt: skip
            await self._vision.answer(("ResultManagement", name), "viewer", handler)
        transfer = ("ResultManagement", "ResultTransfer", "0:GenerateFileForRead")
        await self._vision.answer(transfer, "viewer", self._transfers.open)

    async def end_survey(self, survey: Survey) -> None:
        """Make a finished survey the result of the running job, and end a single job.

        Without a job, or if its files can't be read, the survey yields no result.
        """
        if not self._vision.mode.is_executing:
            return
        emitter = self._vision.emitter
        try:
            result = read_result(
                survey.folder, survey.name, self.job, self._recipes.prepared,
                self._recipes.recipes.configuration,
            )  # fmt: skip
        except InputError as error:
            await emitter.emit("error", str(error), 800)
            return
        self._results.add(result)
        await emitter.emit("acquisition done", f"survey {survey.name} ended", JobId=_job(self.job))
        await emitter.emit("result ready", f"result {survey.name} is ready", 200, **_fields(result))
        if await self._vision.step_itself("job done") is None:
            await self._ready()

    def _starter(self, method: str) -> Any:
        async def start(measurement: Any, part: Any, recipe: Any, product: Any, parameters: Any) -> Any:
            asked = str(recipe.Id or "") if recipe is not None else ""
            if asked not in ("", self._recipes.prepared):
                return [_job(""), int32(NOT_FOUND)]
            failed = await self._vision.step(method)
            if failed is not None:
                return refusal(failed)
            self._jobs += 1
            self.job = f"job-{self._jobs}"
            await self._vision.emitter.emit("job started", f"{self.job} started", JobId=_job(self.job))
            return [_job(self.job), int32(0)]

        return start

    def _stopper(self, method: str) -> Any:
        async def stop(cause: int, description: str | None) -> Any:
            failed = await self._vision.step(method)
            if failed is not None:
                return refusal(failed)
            await self._ready()
            return [int32(0)]

        return stop

    async def _ready(self) -> None:
        await self._vision.emitter.emit("ready", f"ready after {self.job}", JobId=_job(self.job))

    async def _get(self, wanted: Any, timeout: int) -> Any:
        found = self._find(wanted)
        shown = told(found) if found is not None else ua.ResultDataType()
        error = int32(0 if found is not None else NOT_FOUND)
        return [handle(), ua.Variant(shown, ua.VariantType.ExtensionObject), error]

    async def _get_components(self, wanted: Any, timeout: int) -> Any:
        found = self._find(wanted)
        one = told(found) if found is not None else ua.ResultDataType()
        structures = [
            _structure(value)
            for value in (
                ua.MeasIdDataType(), ua.PartIdDataType(), ua.RecipeIdExternalDataType(), one.InternalRecipeId,
                ua.ProductIdDataType(), ua.ConfigurationIdDataType(), one.InternalConfigurationId, one.JobId,
            )
        ]  # fmt: skip
        return [
            ua.Variant(found is not None and found.has_file), handle(), ua.Variant(False),
            ua.Variant(found is not None and found.is_simulated), int32(1 if found is not None else 0),
            *structures, ua.Variant(one.CreationTime, ua.VariantType.DateTime),
            _structure(ua.ProcessingTimesDataType()),
            ua.Variant(list(one.ResultContent or []), ua.VariantType.Variant, is_array=True),
            int32(0 if found is not None else NOT_FOUND),
        ]  # fmt: skip

    async def _list(self, state: Any, *rest: Any) -> Any:
        job, max_results, start = rest[7], rest[8], rest[9]
        asked = str(job.Id or "") if job is not None else ""
        listed = [one for one in self._results.list_newest() if asked in ("", one.job)]
        page = [told(one) for one in listed[start : start + max_results if max_results else None]]
        return [
            ua.Variant(start + len(page) >= len(listed)), ua.Variant(len(page), ua.VariantType.UInt32),
            handle(), ua.Variant(page, ua.VariantType.ExtensionObject, is_array=True), int32(0),
        ]  # fmt: skip

    def _find(self, wanted: Any) -> SurveyResult | None:
        return self._results.get(str(wanted.Id or "")) if wanted is not None else None


async def _release(handle_given: Any) -> Any:
    return [int32(0)]


def _structure(value: Any) -> ua.Variant:
    return ua.Variant(value, ua.VariantType.ExtensionObject)


def _job(name: str) -> ua.Variant:
    return _structure(ua.JobIdDataType(Id=name))


def _fields(result: SurveyResult) -> dict[str, Any]:
    one = told(result)
    return {
        "ResultId": _structure(one.ResultId),
        "JobId": _structure(one.JobId),
        "InternalRecipeId": _structure(one.InternalRecipeId),
        "InternalConfigurationId": _structure(one.InternalConfigurationId),
        "IsPartial": ua.Variant(False, ua.VariantType.Boolean),
        "IsSimulated": ua.Variant(result.is_simulated, ua.VariantType.Boolean),
        "ResultState": ua.Variant(1, ua.VariantType.Int32),
        "CreationTime": ua.Variant(result.created_at, ua.VariantType.DateTime),
        "ResultContent": ua.Variant(
            [ua.Variant(one, ua.VariantType.String) for one in result.content],
            ua.VariantType.Variant, is_array=True,
        ),
    }  # fmt: skip
