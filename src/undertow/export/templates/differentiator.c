static const ut_real ut_gain[UT_N] = {${gains}};

static void ut_differentiate(ut_real gain, ut_real q, ut_real filter[2])
{
${step}
}

static void ut_estimate(ut_controller *c, const ut_real q[UT_N])
{
    for (int i = 0; i < UT_N; i++) {
        /* The estimate is the memory: where they differ, one was upset. */
        const int same = c->filter[i][0] == c->x[i] && c->filter[i][1] == c->x[UT_N + i];
        if (!c->running || !same) {
            c->filter[i][0] = q[i];
            c->filter[i][1] = 0;
        }
        ut_differentiate(ut_gain[i], q[i], c->filter[i]);
        if (!ut_sound(c->filter[i][0]) || !ut_sound(c->filter[i][1])) {
            c->filter[i][0] = q[i];
            c->filter[i][1] = 0;
        }
        c->x[i] = c->filter[i][0];
        c->x[UT_N + i] = c->filter[i][1];
    }
}
