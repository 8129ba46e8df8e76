"""CAN on one computer: a bus between processes, what frames cost on the wire, logs of them.

Shared by drivers and mock robots; nothing in here knows CANopen. `can` is imported where used.
"""
