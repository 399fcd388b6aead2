    from = c->observing ? c->speed : y;
    c->innovation = @KEEP * (c->observing ? c->innovation : R(0.0)) + (y - from);
    c->speed = from + @GAIN * c->innovation;
    c->observing = 1;
    y = c->speed;
