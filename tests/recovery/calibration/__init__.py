"""What the thresholds of diagnosis and tracker are set by: motors, motions and seeds of their own, none of which the
matrix has (`make calibrate`). Motors and motions are the independent generator's kind; `watched` reads off what each
threshold is compared with, `__main__` prints it."""
