"""`python -m servo_daemon` is `servo-daemon`."""

import sys

from servo_daemon.cli import main

sys.exit(main())
