"""What light does: a scene in, five linear pictures out, and the photograph a camera would make of them."""
