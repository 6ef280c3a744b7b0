"""One case: what it says, what came out of it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from palpate.front_door import front_door

if TYPE_CHECKING:
    from palpate.study.body import Body as Body
    from palpate.study.body import inverse_problem as inverse_problem
    from palpate.study.body import make_body as make_body
    from palpate.study.case import Case as Case
    from palpate.study.case import Discrepancy as Discrepancy
    from palpate.study.case import Domain as Domain
    from palpate.study.case import DriverMotion as DriverMotion
    from palpate.study.case import Mechanics as Mechanics
    from palpate.study.case import MeshSettings as MeshSettings
    from palpate.study.case_body import Phantom as Phantom
    from palpate.study.case_file import read_case as read_case
    from palpate.study.case_loads import loads_on as loads_on
    from palpate.study.cost import ExpectedCost as ExpectedCost
    from palpate.study.cost import expected_cost as expected_cost
    from palpate.study.earlier import strange_files as strange_files
    from palpate.study.edge_length import edge_length_of as edge_length_of
    from palpate.study.estimation import Observed as Observed
    from palpate.study.estimation import conclude as conclude
    from palpate.study.imaged import ImagedStates as ImagedStates
    from palpate.study.imaged import aligned as aligned
    from palpate.study.lock import own_file as own_file
    from palpate.study.outputs import OutputFolder as OutputFolder
    from palpate.study.outputs import make_folder as make_folder
    from palpate.study.outputs import read_json as read_json
    from palpate.study.outputs import write_json as write_json
    from palpate.study.provenance import software_versions as software_versions
    from palpate.study.read import read_states as read_states
    from palpate.study.result import CaseResult as CaseResult
    from palpate.study.result import failure_document as failure_document
    from palpate.study.run import estimate as estimate
    from palpate.study.run import estimate_states as estimate_states
    from palpate.study.run import fitted_states as fitted_states
    from palpate.study.run import inversion_settings as inversion_settings
    from palpate.study.simulate import filled as filled
    from palpate.study.stated_posterior import StatedPosterior as StatedPosterior
    from palpate.study.stated_posterior import as_stated as as_stated
    from palpate.study.verdicts import estimates_of as estimates_of
    from palpate.study.verdicts import intervals_of as intervals_of
    from palpate.study.verdicts import verdict as verdict

__getattr__, __dir__ = front_door(__name__)
