import os
import tempfile

# Loading a dataset fills a cache, and these are read when `datasets` is imported.
os.environ["HF_HOME"] = tempfile.mkdtemp(prefix="cpn-export-test-")
os.environ["HF_HUB_OFFLINE"] = "1"
