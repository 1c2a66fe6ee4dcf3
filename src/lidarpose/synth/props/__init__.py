"""Things that people carry, wear, push, sit on and ride."""

from lidarpose.synth.props.drawing import POSED_WITH_A_PROP, draw_props
from lidarpose.synth.props.prop import Prop

__all__ = ["POSED_WITH_A_PROP", "Prop", "draw_props"]
