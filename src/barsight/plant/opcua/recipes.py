"""Answer the methods of recipes (a preset with its magnet) and configurations (a calibration)."""

from __future__ import annotations

import datetime
from dataclasses import dataclass
from typing import Any

from barsight.core.errors import Failed
from barsight.plant.opcua.calls import Handler
from barsight.plant.opcua.machine import step_by_method
from barsight.plant.opcua.security.binding import ua
from barsight.plant.opcua.vision import VisionSystem, int32, refusal

NOT_FOUND = 1
"""Error code that a method returns for an unknown id."""


@dataclass(frozen=True)
class Recipes:
    """Ids of the recipes that the run offers, and of its calibration."""

    known: tuple[str, ...]
    configuration: str
    calibrated_at: datetime.datetime


class RecipeMethods:
    """Remember which recipe is prepared, and answer the methods of recipes and configurations."""

    def __init__(self, vision: VisionSystem, recipes: Recipes) -> None:
        self._vision = vision
        self.recipes = recipes
        self._chosen = ""

    @property
    def prepared(self) -> str:
        """Return the prepared recipe: none before Ready, and none after Halt or Reset."""
        return self._chosen if self._vision.mode.automatic not in (None, "Initialized") else ""

    async def add(self) -> None:
        """Link the methods; those that a crane's clients may not call are refused as not supported."""
        recipes: dict[str, tuple[str, Handler]] = {
            "PrepareRecipe": ("engineer", self._prepare),
            "UnprepareRecipe": ("engineer", self._unprepare),
            "GetRecipeListFiltered": ("viewer", self._list_recipes),
            "ReleaseRecipeHandle": ("viewer", _release),
        }
        configurations: dict[str, tuple[str, Handler]] = {
            "GetConfigurationList": ("viewer", self._list_configurations),
            "GetConfigurationById": ("viewer", self._get_configuration),
            "ActivateConfiguration": ("engineer", self._activate),
            "ReleaseConfigurationHandle": ("viewer", _release),
        }
        for folder, methods, others in (
            (
                "RecipeManagement", recipes,
                ("AddRecipe", "RemoveRecipe", "PrepareProduct", "UnprepareProduct", "UnlinkProduct"),
            ),
            ("ConfigurationManagement", configurations, ("AddConfiguration", "RemoveConfiguration")),
        ):  # fmt: skip
            for name, (role, handler) in methods.items():
                await self._vision.answer((folder, name), role, handler)
            for name in others:
                await self._vision.answer((folder, name), "engineer", _not_supported)
        active = await self._vision.find(("ConfigurationManagement", "ActiveConfiguration"))
        await active.write_value(ua.Variant(self._configuration(), ua.VariantType.ExtensionObject))

    async def _prepare(self, external: Any, internal: Any) -> Any:
        if isinstance(refused := step_by_method(self._vision.mode, "PrepareRecipe"), Failed):
            return refusal(refused)
        name = _id_of(internal) or _id_of(external)
        if name not in self.recipes.known:
            return [_recipe(""), ua.Variant(False), int32(NOT_FOUND)]
        self._chosen = name
        await self._vision.step("PrepareRecipe")
        await self._vision.emitter.emit(
            "recipe prepared", f"recipe {name} is prepared", InternalId=_recipe(name)
        )
        return [_recipe(name), ua.Variant(True), int32(0)]

    async def _unprepare(self, external: Any, internal: Any) -> Any:
        if isinstance(refused := step_by_method(self._vision.mode, "UnprepareRecipe"), Failed):
            return refusal(refused)
        name = _id_of(internal) or _id_of(external)
        if name != self.prepared:
            return [_recipe(""), int32(NOT_FOUND)]
        await self._vision.step("UnprepareRecipe")
        return [_recipe(name), int32(0)]

    async def _list_recipes(
        self, external: Any, product: Any, is_prepared: Any, max_results: int, start: int, timeout: int
    ) -> Any:
        wanted = _id_of(external)
        names = [one for one in self.recipes.known if not wanted or one == wanted]
        if is_prepared is not None and int(is_prepared) in (0, 1):
            names = [one for one in names if (one == self.prepared) == bool(int(is_prepared))]
        page = names[start : start + max_results if max_results else None]
        listed = [ua.RecipeIdInternalDataType(Id=one) for one in page]
        return [
            ua.Variant(start + len(page) >= len(names)), ua.Variant(len(page), ua.VariantType.UInt32),
            handle(),
            ua.Variant(listed, ua.VariantType.ExtensionObject, is_array=True), int32(0),
        ]  # fmt: skip

    def _configuration(self) -> Any:
        configuration = ua.ConfigurationDataType()
        configuration.HasTransferableDataOnFile = False
        configuration.InternalId = ua.ConfigurationIdDataType(Id=self.recipes.configuration)
        configuration.LastModified = self.recipes.calibrated_at
        return configuration

    async def _list_configurations(self, max_results: int, start: int, timeout: int) -> Any:
        page = [self._configuration()][start : start + max_results if max_results else None]
        return [
            ua.Variant(True), ua.Variant(len(page), ua.VariantType.UInt32), handle(),
            ua.Variant(page, ua.VariantType.ExtensionObject, is_array=True), int32(0),
        ]  # fmt: skip

    async def _get_configuration(self, internal: Any, timeout: int) -> Any:
        is_there = _id_of(internal) == self.recipes.configuration
        configuration = self._configuration() if is_there else ua.ConfigurationDataType()
        shown = ua.Variant(configuration, ua.VariantType.ExtensionObject)
        return [handle(), shown, int32(0 if is_there else NOT_FOUND)]

    async def _activate(self, internal: Any) -> Any:
        return [int32(0 if _id_of(internal) == self.recipes.configuration else NOT_FOUND)]


def handle() -> ua.Variant:
    """Make the handle 0: no resources are held, so nothing has to be released."""
    return ua.Variant(0, ua.VariantType.UInt32)


async def _release(handle_given: Any) -> Any:
    return [int32(0)]


async def _not_supported(*arguments: Any) -> Any:
    return ua.StatusCode(ua.StatusCodes.BadNotSupported)


def _recipe(name: str) -> ua.Variant:
    return ua.Variant(ua.RecipeIdInternalDataType(Id=name), ua.VariantType.ExtensionObject)


def _id_of(structure: Any) -> str:
    return str(structure.Id or "") if structure is not None else ""
