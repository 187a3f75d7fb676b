"""Moving objects: association, rigid motion, filter and state of each; steps 5 and 7 to 9."""
