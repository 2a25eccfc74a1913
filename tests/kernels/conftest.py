"""Scripts that tests run in processes of their own are no modules of tests."""

collect_ignore = ["compiled.py", "interpreted.py"]
