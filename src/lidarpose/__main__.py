from lidarpose.cli import main

raise SystemExit(main())
