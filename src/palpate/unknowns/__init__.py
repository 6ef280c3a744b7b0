"""The unknowns and their prior: log-moduli, and blocks of further unknowns."""

from palpate.unknowns.arrowhead import Arrowhead as Arrowhead
from palpate.unknowns.arrowhead import Places as Places
from palpate.unknowns.blocks import FIELD as FIELD
from palpate.unknowns.blocks import KNOWN_MODULUS as KNOWN_MODULUS
from palpate.unknowns.blocks import PATCHINESS as PATCHINESS
from palpate.unknowns.blocks import Acts as Acts
from palpate.unknowns.blocks import Alternative as Alternative
from palpate.unknowns.blocks import Block as Block
from palpate.unknowns.blocks import Choice as Choice
from palpate.unknowns.blocks import frame_blocks as frame_blocks
from palpate.unknowns.blocks import in_series as in_series
from palpate.unknowns.blocks import instrument_block as instrument_block
from palpate.unknowns.blocks import known_modulus_blocks as known_modulus_blocks
from palpate.unknowns.blocks import layer_blocks as layer_blocks
from palpate.unknowns.blocks import material_blocks as material_blocks
from palpate.unknowns.blocks import offset_block as offset_block
from palpate.unknowns.blocks import reference_block as reference_block
from palpate.unknowns.blocks import sought_ratio_blocks as sought_ratio_blocks
from palpate.unknowns.blocks import unit_blocks as unit_blocks
from palpate.unknowns.blocks import wall_blocks as wall_blocks
from palpate.unknowns.parameters import ParameterMap as ParameterMap
from palpate.unknowns.parameters import parameter_map as parameter_map
