"""What people carry, wear, push, sit on and ride."""

from lidarpose.synth.props.attachments import Prop, draw_props

__all__ = ["Prop", "draw_props"]
