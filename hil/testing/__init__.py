"""pytest plug-in for people who test against hil's mocks."""
