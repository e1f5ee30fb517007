"""The Zenoh bus: messages, session, lockstep."""
