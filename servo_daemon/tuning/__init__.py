"""Controller gains for the motor as it is: PI speed loop, PID position loop, LQR, and how robust each is.

Pure: parameters with their covariance in, frozen records out; nothing here knows an estimator, a driver or the daemon.
`knowledge.py` what is known of motor and loop · `sampled.py` both as they are sampled · `laws.py` the control laws ·
`margins.py` margins of many motors at once · `worst.py` the worst of a region · `response.py` steps and bandwidth ·
`design.py`, `search.py` gains for a bandwidth or a settling time · `assess.py` gains in use · `advice.py` what linear
theory does not say · `report.py`, `document.py` all of it.
"""
