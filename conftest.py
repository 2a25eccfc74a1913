"""What cannot be imported here has no doctests here."""

import importlib.util

collect_ignore_glob = [] if importlib.util.find_spec("triton") else ["torchkcreg/kernels/gpu/*"]
