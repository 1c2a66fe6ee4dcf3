"""Things that people carry, wear, push, sit on and ride."""

from lidarpose.synth.props.attachments import POSED_WITH_A_PROP, Prop, draw_props

__all__ = ["POSED_WITH_A_PROP", "Prop", "draw_props"]
