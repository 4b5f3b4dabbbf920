"""A law designed for one plant and used on another: what an uncertain plant demands of it."""

from collections.abc import Mapping
from typing import Any

import equinox as eqx

from jaxbeam.case.case import Case, replace
from jaxbeam.case.controller import AbstractController
from jaxbeam.model.modes import Layout
from jaxbeam.model.state_space import state_space


class FixedDesign(AbstractController):
    """A `law` whose gains and estimators are designed for the `design_case` case; else it is as it is.

    Laws design themselves for the rig of their case (`AbstractController.init`). Where that rig is
    uncertain, they would otherwise know each plant that is tried.
    """

    law: AbstractController = eqx.field(kw_only=True)
    design_case: Case = eqx.field(kw_only=True)
    layout: Layout = eqx.field(static=True, kw_only=True)

    @property
    def stateless(self) -> bool:
        return self.law.stateless

    @property
    def open_loop(self) -> bool:
        return self.law.open_loop

    @property
    def design_depends_on_loads(self) -> bool:
        return self.law.design_depends_on_loads

    def init(self, plant):
        return self.law.init(state_space(self.design_case, layout=self.layout))

    def step(self, memory, measurement, t):
        return self.law.step(memory, measurement, t)

    def own_filters(self):
        return self.law.own_filters()

    def own_states(self, memory):
        return self.law.own_states(memory)

    def flow(self, memory, own, measurement, t, limited):
        return self.law.flow(memory, own, measurement, t, limited)

    def validate(self, case):
        return self.law.validate(case)

    def failures(self, memory):
        return self.law.failures(memory)

    def breakpoints(self, case):
        return self.law.breakpoints(case)


def with_fixed_design(case: Case, nominal: Mapping[str, Any], layout: Layout) -> Case:
    """The case with a controller that takes the numbers at some addresses for the `nominal` ones.

    `layout` is the order of places along the beam, the same for both.
    """
    law = case.controller
    if not nominal or law is None:
        return case
    sampling = {name: getattr(law, name) for name in ("period", "delay", "resolution")}
    wrapped = FixedDesign(
        law=law, design_case=replace(case, dict(nominal)), layout=layout, **sampling
    )
    return eqx.tree_at(lambda c: c.controller, case, wrapped)
