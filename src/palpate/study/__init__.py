"""What is done with a case: estimate, check, begin, simulate, vary, compare a null pair."""

from __future__ import annotations

from typing import TYPE_CHECKING

from palpate.front_door import front_door

if TYPE_CHECKING:
    from palpate.study.lock import own_file as own_file
    from palpate.study.outputs import OutputFolder as OutputFolder
    from palpate.study.outputs import make_folder as make_folder
    from palpate.study.outputs import read_json as read_json
    from palpate.study.outputs import write_json as write_json
    from palpate.study.run import estimate as estimate
    from palpate.study.run import estimate_states as estimate_states
    from palpate.study.run import fitted_states as fitted_states
    from palpate.study.run import inversion_settings as inversion_settings
    from palpate.study.run import make_mesh as make_mesh
    from palpate.study.simulate import filled as filled

__getattr__, __dir__ = front_door(__name__)
