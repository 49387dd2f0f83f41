"""A live page on this machine alone: what is drawn, the page, and who serves it.

What is shown comes from whoever implements :class:`Show`; :mod:`undertow.studies.live` does, for a
cascade in real time and for the log of a run.
"""

from undertow.display.live.page import saved_page
from undertow.display.live.scene import Grip, Scene
from undertow.display.live.server import Message, Show, check_port, serve

__all__ = ["Grip", "Message", "Scene", "Show", "check_port", "saved_page", "serve"]
