"""Run the OPC UA server: variables always, the vision system if its NodeSet is available."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from dataclasses import dataclass

from barsight.plant.link_settings import OpcUaSettings
from barsight.plant.opcua.alarms import Conditions
from barsight.plant.opcua.events import Emitter
from barsight.plant.opcua.jobs import JobMethods
from barsight.plant.opcua.lift_methods import LiftMethods
from barsight.plant.opcua.recipes import RecipeMethods, Recipes
from barsight.plant.opcua.security.access import BoundedServer, PasswordUsers, PlantRules, read_users
from barsight.plant.opcua.security.binding import Node, Server, ua
from barsight.plant.opcua.security.certificates import own_certificate
from barsight.plant.opcua.surveys import PlantSource, Told
from barsight.plant.opcua.variables import StateVariables
from barsight.plant.opcua.vision import ERROR_CONDITION, VisionSystem

URI = "urn:barsight:crane"
"""URI of the application and of its namespace."""


@dataclass(frozen=True)
class _Shown:
    """The parts of the address space that are updated from the plant."""

    variables: StateVariables
    conditions: Conditions
    vision: VisionSystem | None
    jobs: JobMethods | None


@contextlib.asynccontextmanager
async def opcua_server(
    settings: OpcUaSettings, kind: type, source: PlantSource, recipes: Recipes
) -> AsyncIterator[asyncio.Task[None]]:
    """Serve `source` while the block runs; yield the task that updates the server from it.

    kind: dataclass of the snapshot.
    """
    nodeset = settings.nodeset
    own = own_certificate(settings.folder, URI, settings.host)
    users = PasswordUsers(read_users(settings.users), settings.allow_anonymous)
    server = Server(BoundedServer(settings, users))
    await server.init()
    server.set_endpoint(settings.url)
    server.set_server_name("Barsight")
    await server.set_application_uri(URI)
    server.set_security_policy(
        [ua.SecurityPolicyType.NoSecurity, ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt],
        permission_ruleset=PlantRules(),
    )
    server.set_identity_tokens([ua.AnonymousIdentityToken, ua.UserNameIdentityToken])
    await server.load_certificate(own.certificate)
    await server.load_private_key(own.key)
    index = await server.register_namespace(URI)
    root = await server.nodes.objects.add_object(
        ua.NodeId("Barsight", index), ua.QualifiedName("Barsight", index)
    )
    vision = await VisionSystem.add(server, nodeset, index) if nodeset is not None else None
    shown = await _add(server, root, index, vision, kind, recipes, settings)
    await LiftMethods(server, source).add(root, index)
    async with server:
        following = asyncio.create_task(_follow(shown, source, settings))
        try:
            yield following
        finally:
            following.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await following


async def _add(
    server: Server, root: Node, index: int, vision: VisionSystem | None, kind: type, recipes: Recipes,
    settings: OpcUaSettings,
) -> _Shown:  # fmt: skip
    state = await root.add_object(ua.NodeId("State", index), ua.QualifiedName("State", index))
    variables = await StateVariables.add(server, state, kind, index)
    parent = root if vision is None else vision.system
    emitter = Emitter(server, [server.nodes.server, root]) if vision is None else vision.emitter
    condition = ua.NodeId(ua.ObjectIds.AlarmConditionType) if vision is None else vision.node(ERROR_CONDITION)
    conditions = Conditions(server, parent, emitter, condition, index)
    await conditions.add_methods()
    if vision is None:
        return _Shown(variables, conditions, None, None)
    prepared = RecipeMethods(vision, recipes)
    await prepared.add()
    jobs = JobMethods(vision, prepared, settings.kept_results)
    await jobs.add()

    async def confirm_all(comment: ua.LocalizedText | None) -> list[ua.Variant]:
        await conditions.acknowledge_all((comment.Text or "")[:1000] if comment is not None else "")
        return []

    await vision.answer(("VisionStateMachine", "ConfirmAll"), "operator", confirm_all)
    return _Shown(variables, conditions, vision, jobs)


async def _follow(shown: _Shown, source: PlantSource, settings: OpcUaSettings) -> None:
    """Update the address space from the source repeatedly; all variables are Bad if it returns nothing."""
    survey: str | None = None
    is_first = True
    while True:
        newest = await source.told()
        if newest is None:
            await shown.variables.quiet(ua.StatusCodes.BadNoCommunication)
        else:
            await shown.variables.show(newest.state)
            await shown.conditions.show(newest.alarms)
            if shown.vision is not None:
                await _follow_errors(shown.vision, newest)
            name = newest.survey.name if newest.survey is not None else None
            if shown.jobs is not None and newest.survey is not None and name != survey and not is_first:
                await shown.jobs.end_survey(newest.survey)
            survey, is_first = name, False
        await asyncio.sleep(settings.state_every_s)


async def _follow_errors(vision: VisionSystem, newest: Told) -> None:
    """Enter the state Error with the first alarm of that level, and leave it when the last one has ended."""
    errors = [alarm for alarm in newest.alarms if alarm.level == "error"]
    if errors and await vision.step_itself("error") is None:
        await vision.emitter.emit("error", errors[0].text, 800)
    if not errors and await vision.step_itself("error resolved") is None:
        await vision.emitter.emit("error resolved", "no error stands any more", 200)
