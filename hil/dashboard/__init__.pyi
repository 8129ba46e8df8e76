from .server import listen as listen
from .server import serve as serve
from .settings import Settings as Settings
from .settings import token_for as token_for
