@OPENING#include <stdio.h>

#include "@NAME.h"

@TABLES
int main(void)
{
@BODY    printf("%d of @COUNT samples differ\n", wrong);
    return wrong != 0;
}
