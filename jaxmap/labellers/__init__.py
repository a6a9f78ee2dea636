"""What gives each point of a frame its class; all labellers have one signature."""
