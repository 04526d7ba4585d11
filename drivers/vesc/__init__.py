"""VESC: packets on USB and UART, status frames on CAN."""
