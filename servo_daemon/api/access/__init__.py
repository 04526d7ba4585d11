"""What stands between the network and the routes: who may ask, how much, and on how many connections."""
