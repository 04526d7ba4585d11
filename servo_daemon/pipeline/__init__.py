"""From sample blocks to what is published of them: no thread, no socket, no clock."""
