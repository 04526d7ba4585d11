"""The project's own CAN frames (docs/protocol-can.md), decoded and dated."""
