"""Estimates and events to an MQTT broker: JSON with Home Assistant's discovery, or Sparkplug B."""
