"""moteus: queries over an fdcanusb adapter or a CAN FD bus."""
