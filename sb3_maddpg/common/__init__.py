"""What all algorithms share: actions, estimators, networks, policies, replay buffers, callbacks."""
