"""A body as it is read, meshed and observed."""

from __future__ import annotations

from typing import TYPE_CHECKING

from palpate.front_door import front_door

if TYPE_CHECKING:
    from palpate.body.body import Body as Body
    from palpate.body.body import inverse_problem as inverse_problem
    from palpate.body.body import make_body as make_body
    from palpate.body.edge_length import edge_length_of as edge_length_of
    from palpate.body.imaged import ImagedStates as ImagedStates
    from palpate.body.imaged import aligned as aligned
    from palpate.body.provenance import software_versions as software_versions
    from palpate.body.read import read_states as read_states

__getattr__, __dir__ = front_door(__name__)
