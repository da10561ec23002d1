"""`lensmodel` whose workers have tasks of another module beside this file: `service.py light_tasks serve`."""

if __name__ == "__main__":
    import os
    import sys
    from pathlib import Path

    from app.runtime import supervisor
    from lensmodel.cli import main as cli

    here = str(Path(__file__).parent)
    os.environ["LENSMODEL_TASKS"] = sys.argv.pop(1)
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [here, os.environ.get("PYTHONPATH")]))
    supervisor.WORKER = "stand_in_worker"
    cli.main()
